"""The record of a rollout, and the exception for one that has diverged."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from mjxgrad.rollouts.state import State

LARGEST_GROWTH = 1e3
"""Growth of a tangent that counts as exploding. In half a second of free motion 1 m/s becomes 0.5 m; a bounce reduces it."""


class Trajectory(eqx.Module):
    """The course of one rollout; under `jax.vmap` every field gains leading axes.

    Attributes:
        qpos: positions before each step and after the last.
        qvel: velocities at the same times.
        ctrl: controls applied in each step, noise included.
        observations: stacked results of `observe` for each of these states, under the control of the next step (the last step
            for the last state); None without it.
        seen: stacked observations given to the policy; None for other policies.
        final: the last state, to continue from.
        diverged: whether some step gave a non-finite or runaway state, or the model holds NaN.
        first_bad_step: the first such step, −1 if there is none. From there on the state stays at the last good one.
        unsolved: number of steps before it with an inaccurate solve: it ran into the model's iteration limit, or this
            precision does not resolve its forces to a thousandth, by an estimate of rounding. Motion and derivative, which
            assumes a converged solve, are then inexact. Zero, unless `opt.iterations` is small or, in single precision,
            pyramids have little friction (below 0.01; elliptic cones hardly have such a limit). Only `rollout` counts it.
        crowded: number of steps before it in which more contacts may have acted than the scene has slots for, see
            `max_contacts` of `load_scene`. Smoothed contacts act at any distance, so then every step of such a scene counts.
        growth: largest growth of one fixed unit tangent of all initial velocities and positions along the way; None unless
            asked for.
        act: activations of actuators, as positions; only `rollout` keeps them.
    """

    qpos: Float[Array, "states nq"]
    qvel: Float[Array, "states nv"]
    ctrl: Float[Array, "horizon nu"]
    observations: PyTree
    final: State
    diverged: Bool[Array, ""]
    first_bad_step: Int[Array, ""]
    unsolved: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    crowded: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    growth: Float[Array, ""] | None = None
    act: Float[Array, "states na"] | None = None
    seen: PyTree = None

    @property
    def explodes(self) -> Bool[Array, "*batch"]:
        """Whether the derivative has grown a thousandfold, or is not finite. False if growth was not measured."""
        return jnp.zeros_like(self.diverged) if self.growth is None else self.growth > LARGEST_GROWTH


class DivergedError(FloatingPointError):
    """A rollout left the range in which its numbers mean anything."""


def check_trajectory(trajectory: Trajectory) -> None:
    """Raise if any rollout of a trajectory, batched or not, has diverged. Call it on the host.

    Raises:
        DivergedError: with the number of diverged rollouts and the earliest bad step.
    """
    diverged = jnp.atleast_1d(trajectory.diverged)
    if not bool(diverged.any()):
        return
    first = int(jnp.min(jnp.where(diverged, jnp.atleast_1d(trajectory.first_bad_step), 2**30)))
    raise DivergedError(
        f"{int(diverged.sum())} of {diverged.size} rollouts diverged, the earliest in step {first}: "
        "the state must stay finite and below 10 000 m/s or rad/s; shorten the time step, soften the contact, "
        "or look for a non-finite control"
    )
