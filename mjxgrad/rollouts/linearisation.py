"""A, B, C and D of one step, in the coordinates and the order of MuJoCo's `mjd_transitionFD`."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.engines import linearise as by_mujoco
from mjxgrad.rollouts.arguments import arguments_of, check_start, native_motion, sequence_of
from mjxgrad.rollouts.state import State, data_of
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, Slope, step


class Linearisation(eqx.Module):
    """Derivatives of the next state and the sensors; a change of state is (positions, velocities, activations).

    Positions change in tangent space, a quaternion by three numbers (m, rad).

    Attributes:
        A: derivative of the next state by the present one.
        B: derivative of the next state by the controls.
        C: derivative of the sensors by the present state.
        D: derivative of the sensors by the controls.
    """

    A: Float[Array, "changes changes"]
    B: Float[Array, "changes nu"]
    C: Float[Array, "nsensordata changes"]
    D: Float[Array, "nsensordata nu"]


def linearise(
    scene: Scene, state: State, ctrl: Float[ArrayLike, " nu"] | None = None, *, contact: Contact = Slope()
) -> Linearisation:
    """Return the linear model of one step from a state; use `jax.vmap` for a batch of states.

    The controls are the scene's resting ones by default. Contact is stepped as in `rollout`: the default is the model of the
    outcome, and `mg.Discrete()` corresponds to `mjd_transitionFD`.

    Raises:
        ValueError: as `rollout`.
    """
    check_start(scene, state)
    ctrl = scene.data.ctrl if ctrl is None else jnp.asarray(ctrl, scene.data.ctrl.dtype)
    sequence_of(ctrl[None], None, 1, scene.model.nu)
    native = native_motion(scene, contact)
    if native is not None:
        start, resting = arguments_of(scene, state)
        inputs = {name: value[None] for name, value in (resting | {"ctrl": ctrl}).items()}
        A, B, C, D = by_mujoco(scene, start, inputs, gradient=native.gradient)
        size = 2 * scene.model.nv + scene.model.na  # histories of delays come after
        return Linearisation(A[:size, :size], B[:size], C[:, :size], D)
    nv, size = scene.model.nv, 2 * scene.model.nv + scene.model.na
    end = step(scene.model, data_of(scene, state, ctrl), contact=contact)

    def moved(change: Float[Array, " both"]) -> tuple[Array, Array]:
        data = data_of(scene, state, ctrl + change[size:]).replace(
            qpos=integrate_position(scene.model, state.qpos, change[:nv], 1.0),
            qvel=state.qvel + change[nv : 2 * nv],
            act=state.act + change[2 * nv : size],
        )
        found = step(scene.model, data, contact=contact)
        change = position_change(scene.model, end.qpos, found.qpos)
        return jnp.concatenate([change, found.qvel, found.act]), found.sensordata

    of_state, of_sensors = jax.jacfwd(moved)(jnp.zeros(size + scene.model.nu, state.qvel.dtype))
    return Linearisation(of_state[:, :size], of_state[:, size:], of_sensors[:, :size], of_sensors[:, size:])
