"""A, B, C and D of one step, in the coordinates and the order of MuJoCo's `mjd_transitionFD`."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from mjxgrad.engines import State, engine_of
from mjxgrad.rollouts.arguments import check_start, sequence_of
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, Slope


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
    outcome, and `mg.Discrete()` corresponds to `mjd_transitionFD`, whose D by MuJoCo 3.17 has the wrong sign if centred.

    Raises:
        ValueError: as `rollout`.
    """
    check_start(scene, state)
    ctrl = scene.data.ctrl if ctrl is None else jnp.asarray(ctrl, scene.data.ctrl.dtype)
    sequence_of(ctrl[None], None, 1, scene.model.nu)
    return Linearisation(*engine_of(scene, contact).linearise(scene, state, ctrl, contact))
