r"""Adaptive integration with diffrax: the motion to any accuracy, as a reference for fixed steps.

The state moves by $\dot v = $ `forward`'s acceleration and $\dot q = $ the velocity in coordinates. A quaternion
turns by $\tfrac12 q \otimes (0, \omega)$. The integration keeps its norm to the tolerance, and every use normalises it. At
a force jump the error control rejects steps until one is short enough that the jump does no harm.

**Its derivative.** Reverse mode goes through the accepted steps. Where contact forces begin continuously ($d_0 = 0$) it
converges to the derivative of the motion. Where they jump (MuJoCo's default, $d_0 = 0.9$) it does not, at any tolerance:
the jump stays within some step, as with fixed steps. The reference for the derivative is then the difference quotient of two
adaptive rollouts, whose motion is accurate in both cases.

References:
    Kidger. On Neural Differential Equations. PhD thesis, Oxford 2021 (diffrax).
    Paulus, Geist, Schumacher, Musil, Rappenecker, Martius. Hard Contacts with Soft Gradients: Refining Differentiable
    Simulators for Learning and Control (DiffMJX). arXiv:2506.14186, which integrates so, too, with contact from a distance.
"""

import importlib
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from mjxgrad.bodies.kinematics import integrate_position
from mjxgrad.rollouts.state import State, data_of
from mjxgrad.scene import Scene
from mjxgrad.stepping import forward

diffrax: Any = importlib.import_module("diffrax")  # its types are narrower than what it takes
Rates = tuple[Float[Array, " nq"], Float[Array, " nv"], Float[Array, " na"]]


class AdaptiveTrajectory(eqx.Module):
    """States at the requested times.

    Attributes:
        times: the times, in s.
        qpos: positions at these times, quaternions normalised.
        qvel: velocities at these times.
        num_steps: number of all steps, including rejected ones.
        has_failed: whether the steps ran out, or the state ceased to be finite; the states are then without meaning.
    """

    times: Float[Array, " times"]
    qpos: Float[Array, "times nq"]
    qvel: Float[Array, "times nv"]
    num_steps: Int[Array, ""]
    has_failed: Bool[Array, ""]


def adaptive_rollout(
    scene: Scene,
    state: State,
    times: Float[ArrayLike, " times"] | Sequence[float],
    *,
    tolerance: Float[ArrayLike, ""] = 1e-6,
    max_steps: int = 16384,
) -> AdaptiveTrajectory:
    """Integrate a scene under its resting controls, with error control.

    Differentiable in reverse mode; see the module for the limits of the derivative.

    Args:
        scene: from `load_scene`. Its integrator is not used; its time step only where `refsafe` clamps contact parameters.
        state: the initial state.
        times: output times since the start, increasing (s).
        tolerance: relative and absolute tolerance on the error of a step.
        max_steps: largest number of steps. Memory in reverse mode grows with its square root.

    Returns:
        The states, and the number of steps.
    """
    moments = jnp.asarray(times, state.qpos.dtype)

    def vector_field(t: Float[Array, ""], y: Rates, _: None) -> Rates:
        qpos, qvel, act = y
        now = State(qpos, qvel, act, state.time + t, state.warmstart)
        data = forward(scene.model, data_of(scene, now, scene.data.ctrl))
        zero = jnp.zeros((), qpos.dtype)
        carried = jax.jvp(lambda s: integrate_position(scene.model, qpos, qvel, s), (zero,), (zero + 1,))[1]
        return carried, data.qacc, data.act_dot

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field),
        diffrax.Bosh3(),  # of third order: contact forces are not smooth enough for more
        t0=jnp.zeros_like(moments[0]),
        t1=moments[-1],
        dt0=None,
        y0=(state.qpos, state.qvel, state.act),
        saveat=diffrax.SaveAt(ts=moments),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=max_steps,
        throw=False,
    )
    qpos, qvel, _ = solution.ys
    has_failed = (solution.result != diffrax.RESULTS.successful) | ~jnp.all(jnp.isfinite(qvel))
    normalised = jax.vmap(lambda q: integrate_position(scene.model, q, jnp.zeros_like(state.qvel), 0.0))(qpos)
    return AdaptiveTrajectory(
        times=moments,
        qpos=normalised,
        qvel=qvel,
        num_steps=jnp.asarray(solution.stats["num_steps"]),
        has_failed=has_failed,
    )
