"""States and trajectories, whoever steps the scene."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from mjxgrad._arrays import Legible, instance
from mjxgrad._mjx import mjx
from mjxgrad.scene import Scene
from mjxgrad.stepping.pairs import Flight

VELOCITY_LIMIT = 1e4  # m/s or rad/s, beyond which a rollout counts as diverged
LARGEST_GROWTH = 1e3
"""Growth of a tangent that counts as exploding. In half a second of free motion 1 m/s becomes 0.5 m; a bounce reduces it."""


class Pairs(eqx.Module):
    """Pairs of motions that a slope by C MuJoCo follows, see `engines.flight`; empty where nothing is differentiated."""

    # Both motions of each, as changes of the state, how far apart they began, and how they are followed.
    flight: Float[Array, "slots numbers"]
    held: Float[Array, " slots"]  # zeros, whose derivative is what each pair has felt of a change


class State(Legible):
    """The state before a step.

    Attributes:
        qpos: generalised positions (m, rad, unit quaternions).
        qvel: generalised velocities (m/s, rad/s).
        act: actuator activations.
        time: simulated time (s).
        warmstart: acceleration at which the next solve starts. It affects the solve's duration, not its result.
        history: past controls and readings, of delays, and states of plugins; as MuJoCo keeps them.
        pairs: pairs of motions that a slope follows, as its engine keeps them. None: they are let go at the end of a rollout.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    time: Float[Array, ""]
    warmstart: Float[Array, " nv"]
    history: Float[Array, " nhistory"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    pairs: Pairs | Flight | None = eqx.field(default=None, repr=False)


class Trajectory(Legible):
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
        unsolved: number of steps before it with an inaccurate solve: it ran into the model's iteration limit, or this precision
            does not resolve its forces to a thousandth. Motion and derivative are then inexact. Zero, unless `opt.iterations` is
            small or, in single precision, pyramids have little friction (below 0.01). Only `rollout` counts it.
        crowded: number of steps before it in which more contacts may have acted than the scene has slots for, see
            `max_contacts` of `load_scene`. Smoothed contacts act at any distance, so then every step of such a scene counts.
        growth: largest growth of one fixed unit tangent of all initial velocities and positions along the way, if asked for.
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


def data_of(scene: Scene, state: State, ctrl: Float[Array, " nu"]) -> mjx.Data:
    """Return the data of a state, ready to be stepped."""
    return scene.data.replace(
        qpos=state.qpos, qvel=state.qvel, act=state.act, time=state.time, qacc_warmstart=state.warmstart, ctrl=ctrl
    )


def state_of(data: mjx.Data) -> State:
    """Return the state of data."""
    return State(data.qpos, data.qvel, data.act, data.time, data.qacc_warmstart)


def is_sound(qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], act: Float[Array, " na"]) -> Bool[Array, ""]:
    """Return whether a state is finite and below the velocity limit."""
    # A comparison with NaN is false, so one test finds both.
    return jnp.all(jnp.isfinite(jnp.concatenate([qpos, act]))) & jnp.all(jnp.abs(qvel) < VELOCITY_LIMIT)


def direction(state: State) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """Return a unit tangent of the initial state, the same for every rollout of a scene."""
    random = np.random.default_rng(0)
    parts = (random.normal(size=state.qpos.shape), random.normal(size=state.qvel.shape))
    size = np.sqrt(sum((part**2).sum() for part in parts))
    return tuple(jnp.asarray(part / size, state.qvel.dtype) for part in parts)  # pyright: ignore[reportReturnType]


def check_scene(scene: Any) -> None:
    """Refuse what is no scene, or one of a precision that is off."""
    instance("scene", scene, Scene, "of mg.load_scene")
    if scene.data.qpos.dtype == jnp.float64 != jnp.result_type(float):
        raise ValueError(
            f"{scene.name} was loaded in double precision, which is off now: load it again, or set jax_enable_x64"
        )


class DivergedError(FloatingPointError):
    """A rollout left the range in which its numbers mean anything."""
