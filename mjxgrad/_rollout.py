"""Many steps: a scan with a lean carry, checkpointed, that says when it has gone wrong."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import Gradient, Onset, Smoothing, check_gradient, forward, smoothing_warnings, step
from mjxgrad.dynamics.implicit import CHECKPOINT_NAME
from mjxgrad.scene import Scene, SceneWarning

Policy = Callable[[PyTree, "State"], Float[Array, " nu"]]
Observe = Callable[[mjx.Model, mjx.Data], PyTree]


class State(eqx.Module):
    """What the next step needs.

    Attributes:
        qpos: generalised positions (m, rad, unit quaternions).
        qvel: generalised velocities (m/s, rad/s).
        act: actuator activations.
        time: simulated time (s).
        warmstart: acceleration from which the next solve starts. It affects the time a solve takes, not its result.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    time: Float[Array, ""]
    warmstart: Float[Array, " nv"]


class Trajectory(eqx.Module):
    """The course of one rollout; under `jax.vmap` every field gains leading axes.

    Attributes:
        qpos: positions before each step and after the last.
        qvel: velocities, likewise.
        ctrl: controls applied in each step, noise included.
        observations: what `observe` returned for each of these states, stacked; None without it.
        final: the last state, to continue from.
        diverged: whether some step gave a non-finite or runaway state.
        first_bad_step: the first such step, −1 if there is none. From there on the state stays at the last good one.
        unsolved: number of steps before it whose solve ran into the model's limit of iterations, short of its tolerance, or
            whose forces, by an estimate of rounding, this precision does not resolve to a thousandth. There the motion is not
            quite that of the model, and the derivative, which takes the solve for finished, not quite its own. Zero, unless
            `opt.iterations` is small or, in single precision, pyramids have little friction (below 0.01; elliptic cones
            hardly have such a limit). Only `rollout` counts it.
        growth: how many times longer a small change of the start has at most become along the way, in one fixed direction of all
            velocities and positions alike; None unless asked for.
    """

    qpos: Float[Array, "states nq"]
    qvel: Float[Array, "states nv"]
    ctrl: Float[Array, "horizon nu"]
    observations: PyTree
    final: State
    diverged: Bool[Array, ""]
    first_bad_step: Int[Array, ""]
    unsolved: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    growth: Float[Array, ""] | None = None

    @property
    def explodes(self) -> Bool[Array, "*batch"]:
        """Whether the derivative has grown beyond belief: a thousandfold, or out of all numbers. False if it was not measured."""
        return jnp.zeros_like(self.diverged) if self.growth is None else self.growth > LARGEST_GROWTH


LARGEST_GROWTH = 1e3
"""Of a change of the start. Half a second of free motion makes half a metre of a metre per second, a bounce less of it."""


class DivergedError(FloatingPointError):
    """A rollout left the range in which its numbers mean anything."""


def initial_state(
    scene: Scene,
    qpos: Float[ArrayLike, " nq"] | None = None,
    qvel: Float[ArrayLike, " nv"] | None = None,
    act: Float[ArrayLike, " na"] | None = None,
) -> State:
    """Return the state at the scene's reference pose, at rest, with the given parts replaced.

    Args:
        scene: where it lives.
        qpos: generalised positions (m, rad, unit quaternions).
        qvel: generalised velocities (m/s, rad/s).
        act: actuator activations.

    Raises:
        ValueError: if a part does not have the shape that the scene gives it.
    """
    data, model = scene.data, scene.model
    parts = {
        "qpos": _part("qpos", qpos, data.qpos, model.nq),
        "qvel": _part("qvel", qvel, data.qvel, model.nv),
        "act": _part("act", act, data.act, model.na),
    }
    return State(**parts, time=jnp.zeros_like(data.time), warmstart=jnp.zeros_like(data.qvel))


def rollout(
    scene: Scene,
    state: State,
    controls: Float[ArrayLike, "_ _"] | Policy | None = None,
    params: PyTree = None,
    noise: Float[ArrayLike, "_ _"] | None = None,
    *,
    horizon: int | None = None,
    observe: Observe | None = None,
    checkpoint: bool = True,
    gradient: Gradient = "discrete",
    onset: Onset | None = None,
    smoothing: Smoothing | None = None,
    velocity_limit: float | None = 1e4,
    measure_growth: bool = False,
) -> Trajectory:
    """Step a scene many times.

    Batches are `jax.vmap` over any argument. Differentiable both ways; a rollout that diverged has no meaningful
    derivative, and `diverged` says so.

    Args:
        scene: from `load_scene`.
        state: where to begin, from `initial_state` or the end of another rollout.
        controls: one row per step; or a policy, called as `policy(params, state)`; or None for the scene's resting ones.
        params: handed to the policy.
        noise: added to the controls, one row per step.
        horizon: number of steps; needed only where neither controls nor noise give it.
        observe: called as `observe(model, data)` with the data of every state, all positions, contacts and forces filled
            in; its results are stacked. Name what you need: what it does not return is not kept.
        checkpoint: recompute each step in reverse mode and keep only its state and acceleration, so that memory grows by
            a few numbers per step. Off, everything is kept: somewhat faster, and hundreds of times larger.
        gradient: of each step: "discrete" or "event", see `step`. The trajectory is the same. The default is what
            finite differences of it give.
        onset: lets contacts and limits begin within the step, see `step`; `mg.Onset()` for costs of motions that hit something,
            as tasks take. None is MuJoCo's motion, to the bit, for which "event" is the derivative that is right in the mean.
        smoothing: averages the contacts of each step over noise on their distance, see `step`. It is said by a
            `SceneWarning` what of the scene it has no effect on.
        velocity_limit: a generalised speed beyond it counts as diverged (m/s, rad/s); None switches this off.
        measure_growth: carry one tangent along and tell by `growth` and `explodes` whether derivatives of this rollout can be
            believed: contacts that chatter may multiply them at every switch. It takes as long as a derivative in forward mode.

    Returns:
        The trajectory, with `horizon + 1` states.

    Raises:
        ValueError: if there is no such gradient, it does not go with onset or smoothing, shapes do not fit the scene, the
            horizon is missing or contradicted, or controls or noise hold numbers that are not finite (checked where
            values are known, that is outside `jax.jit`; inside, the rollout is flagged as diverged at that step).
    """
    check_gradient(gradient)
    if smoothing is not None:
        smoothing.check(gradient)
        for message in smoothing_warnings(smoothing, scene.model):
            warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    if onset is not None:
        onset.check(gradient)
    nu = scene.model.nu
    sequence = None if controls is None or callable(controls) else jnp.asarray(controls)
    horizon = _horizon(horizon, controls=sequence, noise=noise)
    for name, value in (("controls", sequence), ("noise", noise)):
        if value is not None:
            _check_sequence(name, jnp.asarray(value), (horizon, nu))
    _check_state(scene, state)
    policy = controls if callable(controls) else None
    resting = jnp.broadcast_to(scene.data.ctrl, (horizon, nu))
    base = resting if sequence is None else sequence
    inputs = (base, jnp.zeros_like(base) if noise is None else noise)

    def advance(carry: tuple, inputs: tuple[Array, Array, Array]):
        state, first_bad, unsolved, tangent, growth = carry
        index, row, disturbance = inputs
        ctrl = (row if policy is None else policy(params, state)) + disturbance
        data = data_of(scene, state, ctrl)

        def take(qpos: Array, qvel: Array) -> tuple[tuple[Array, Array], mjx.Data]:
            here = data.replace(qpos=qpos, qvel=qvel)
            stepped = step(scene.model, here, gradient=gradient, onset=onset, smoothing=smoothing)
            return (stepped.qpos, stepped.qvel), stepped

        if measure_growth:
            _, tangent, stepped = jax.jvp(take, (state.qpos, state.qvel), tangent, has_aux=True)
            tangent = jax.lax.stop_gradient(tangent)
            growth = jnp.maximum(growth, _length(tangent))  # a NaN stays one
        else:
            stepped = take(state.qpos, state.qvel)[1]
        moved = state_of(stepped)
        is_bad = ~is_sound(moved, velocity_limit)
        first_bad = jnp.where((first_bad < 0) & is_bad, index, first_bad)
        kept = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, moved)
        seen = None if observe is None else _observed(scene, observe, data, stepped, onset, smoothing)
        unsolved += (first_bad < 0) & (stepped._impl.solver_niter > scene.model.opt.iterations)
        return (kept, first_bad, unsolved, tangent, growth), (state.qpos, state.qvel, ctrl, seen)

    if checkpoint:
        keep = jax.checkpoint_policies.save_only_these_names(CHECKPOINT_NAME)
        # Inside a scan nothing can be merged across the barrier that prevent_cse would put up.
        advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
    tangent = _direction(state) if measure_growth else None
    length = jnp.ones((), state.qvel.dtype) if measure_growth else None
    start = (state, jnp.full((), -1, jnp.int32), jnp.zeros((), jnp.int32), tangent, length)
    (final, first_bad, unsolved, _, growth), (qpos, qvel, ctrl, seen) = jax.lax.scan(
        advance,
        start,
        (jnp.arange(horizon, dtype=jnp.int32), *inputs),  # pyright: ignore[reportArgumentType]
    )
    if observe is not None:
        data = data_of(scene, final, ctrl[-1])
        last = observe(scene.model, forward(scene.model, data, onset=onset, smoothing=smoothing))
        seen = jax.tree.map(lambda x, y: jnp.concatenate([x, jnp.asarray(y)[None]]), seen, last)
    return Trajectory(
        qpos=jnp.concatenate([qpos, final.qpos[None]]),
        qvel=jnp.concatenate([qvel, final.qvel[None]]),
        ctrl=ctrl,
        observations=seen,
        final=final,
        diverged=first_bad >= 0,
        first_bad_step=first_bad,
        unsolved=unsolved,
        growth=None if growth is None else jnp.where(jnp.isnan(growth), jnp.inf, growth),
    )


def _direction(state: State) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """Return a change of the start of length one, the same for every rollout of a scene."""
    random = np.random.default_rng(0)
    parts = (random.normal(size=state.qpos.shape), random.normal(size=state.qvel.shape))
    size = np.sqrt(sum((part**2).sum() for part in parts))
    return tuple(jnp.asarray(part / size, state.qvel.dtype) for part in parts)  # pyright: ignore[reportReturnType]


def _length(tangent: tuple[Array, Array]) -> Float[Array, ""]:
    return jnp.sqrt(sum(jnp.sum(part**2) for part in tangent))


def check_trajectory(trajectory: Trajectory) -> None:
    """Raise if any rollout of a trajectory, batched or not, has diverged. Call it on the host.

    Raises:
        DivergedError: naming how many diverged and the earliest bad step.
    """
    diverged = jnp.atleast_1d(trajectory.diverged)
    if not bool(diverged.any()):
        return
    first = int(jnp.min(jnp.where(diverged, jnp.atleast_1d(trajectory.first_bad_step), 2**30)))
    raise DivergedError(
        f"{int(diverged.sum())} of {diverged.size} rollouts diverged, the earliest in step {first}: "
        "the state must stay finite and below the velocity limit; shorten the time step, soften the contact, "
        "or look for a non-finite control"
    )


def data_of(scene: Scene, state: State, ctrl: Float[Array, " nu"]) -> mjx.Data:
    """Give data in a state, ready to be stepped."""
    return scene.data.replace(
        qpos=state.qpos,
        qvel=state.qvel,
        act=state.act,
        time=state.time,
        qacc_warmstart=state.warmstart,
        ctrl=ctrl,
    )


def state_of(data: mjx.Data) -> State:
    """Give the state that data is in."""
    return State(data.qpos, data.qvel, data.act, data.time, data.qacc_warmstart)


def is_sound(state: State, velocity_limit: float | None) -> Bool[Array, ""]:
    """Whether a state is finite and below the velocity limit."""
    limit = jnp.inf if velocity_limit is None else velocity_limit
    numbers = jnp.concatenate([state.qpos, state.act])
    # A comparison with NaN is false, so one test finds both.
    return jnp.all(jnp.isfinite(numbers)) & jnp.all(jnp.abs(state.qvel) < limit)


def _observed(
    scene: Scene,
    observe: Observe,
    data: mjx.Data,
    stepped: mjx.Data,
    onset: Onset | None,
    smoothing: Smoothing | None,
) -> PyTree:
    """Call `observe` with the data of the state before the step."""
    if scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        # The step's own are of its last stage.
        return observe(scene.model, forward(scene.model, data, onset=onset, smoothing=smoothing))
    before = {name: getattr(data, name) for name in ("qpos", "qvel", "act", "time")}
    return observe(scene.model, stepped.replace(**before))


def _part(name: str, value: Any, template: Array, size: int) -> Array:
    value = template if value is None else jnp.asarray(value, template.dtype)
    if value.shape != (size,):
        raise ValueError(f"{name} must have shape ({size},) in this scene, got {value.shape}")
    return value


def _check_state(scene: Scene, state: State) -> None:
    sizes = {"qpos": scene.model.nq, "qvel": scene.model.nv, "act": scene.model.na}
    for name, size in sizes.items():
        shape = jnp.shape(getattr(state, name))
        if shape != (size,):
            raise ValueError(
                f"state.{name} must have shape ({size},) in this scene, got {shape}: map over batches with jax.vmap"
            )


def _horizon(horizon: int | None, **sequences: ArrayLike | None) -> int:
    lengths = {k: int(jnp.shape(v)[0]) for k, v in sequences.items() if v is not None and jnp.ndim(v)}
    if horizon is not None:
        lengths["horizon"] = horizon
    if not lengths:
        raise ValueError("horizon must be given where neither controls nor noise give it, got None")
    if len(set(lengths.values())) > 1:
        given = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"controls, noise and horizon must agree on the number of steps, got {given}")
    length = next(iter(lengths.values()))
    if length < 1:
        raise ValueError(f"horizon must be at least 1, got {length}")
    return length


def _check_sequence(name: str, value: Array, shape: tuple[int, int]) -> None:
    if value.shape != shape:
        raise ValueError(
            f"{name} must have shape {shape}, one row per step and one column per actuator, got {value.shape}"
        )
    if isinstance(value, jax.core.Tracer):
        return
    known = np.asarray(value)  # not jnp, whose operations are traced inside jit even on known values
    if np.isfinite(known).all():
        return
    row, column = np.argwhere(~np.isfinite(known))[0]
    raise ValueError(f"{name} must be finite, got {known[row, column]} in step {row} for actuator {column}")
