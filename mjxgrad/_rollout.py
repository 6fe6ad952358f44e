"""Many steps: a scan with a lean carry, checkpointed, that says when it has gone wrong."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from mjxgrad._arrays import form, is_known, known, whole
from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.contact.collision import first_missed, slot_geoms
from mjxgrad.contact.parameters import geom_name
from mjxgrad.native import INPUTS, roll_out
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.scene.scene import numbers_of
from mjxgrad.stepping import Gradient, Onset, Smoothing, check_gradient, forward, smoothing_warnings, step
from mjxgrad.stepping.onset import reach

Policy = Callable[[PyTree, Any], Float[Array, " nu"]]
"""From its parameters and what it sees to controls."""
Observe = Callable[[mjx.Model, mjx.Data], PyTree]
"""From model and data to anything made of arrays."""
Sees = Literal["state", "observations"]
Engine = Literal["mjx", "mujoco"]
_DEEP = 0.02  # m, that a pose may have a geom inside another
_NO_LIMITS = mujoco.mjtDisableBit.mjDSBL_LIMIT.value | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value


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
        observations: what `observe` returned for each of these states, stacked, under the control of the step that follows
            (of the last step for the last state); None without it.
        seen: what a policy that sees observations was called with, stacked; None for others.
        final: the last state, to continue from.
        diverged: whether some step gave a non-finite or runaway state, or the model holds what is no number.
        first_bad_step: the first such step, −1 if there is none. From there on the state stays at the last good one.
        unsolved: number of steps before it whose solve ran into the model's limit of iterations, short of its tolerance, or
            whose forces, by an estimate of rounding, this precision does not resolve to a thousandth. There the motion is not
            quite that of the model, and the derivative, which takes the solve for finished, not quite its own. Zero, unless
            `opt.iterations` is small or, in single precision, pyramids have little friction (below 0.01; elliptic cones
            hardly have such a limit). Only `rollout` counts it.
        crowded: number of steps before it in which more contacts may have acted than the scene has room for, see `max_contacts`
            of `load_scene`. Under smoothing, where contacts act at any distance, it counts every step of such a scene.
        growth: how many times longer a small change of the start has at most become along the way, in one fixed direction of all
            velocities and positions alike; None unless asked for.
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
    *,
    keyframe: str | int | None = None,
) -> State:
    """Return the state at the scene's reference pose, at rest, or at one of its key frames, with the given parts replaced.

    Where values are known it warns of a joint that begins beyond its limits, which would push it back from the first step, and
    of a pose of the file that is deep inside something.

    Args:
        scene: where it lives.
        qpos: generalised positions (m, rad, unit quaternions).
        qvel: generalised velocities (m/s, rad/s).
        act: actuator activations.
        keyframe: name or number of a key frame of the file, for its positions, velocities and activations.

    Raises:
        ValueError: if a part does not have the shape that the scene gives it, is not finite, has a quaternion of zeros, or there
            is no such key frame.
    """
    _check_scene(scene)
    data, keys, parts = scene.data, {}, []
    if keyframe is not None:
        key = _keyframe(scene.mj_model, keyframe)
        keys = {name: getattr(scene.mj_model, f"key_{name}")[key] for name in ("qpos", "qvel", "act")}
    for name, given in (("qpos", qpos), ("qvel", qvel), ("act", act)):
        template = getattr(data, name)
        part = jnp.asarray(keys.get(name, template) if given is None else given, template.dtype)
        if part.shape != template.shape:
            raise ValueError(f"{name} must have shape {template.shape} in this scene, got {part.shape}")
        if is_known(part) and not np.isfinite(part).all():
            raise ValueError(f"{name} must be finite, got {np.asarray(part).tolist()}")
        parts.append(part)
    for message in pose_warnings(scene.model, scene.mj_model if qpos is None else None, parts[0]):
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    return State(*parts, time=jnp.zeros_like(data.time), warmstart=jnp.zeros_like(data.qvel))


def _keyframe(model: mujoco.MjModel, keyframe: str | int) -> int:
    names = [model.key(i).name or i for i in range(model.nkey)]
    if keyframe in names:
        return names.index(keyframe)
    if isinstance(keyframe, int) and 0 <= keyframe < model.nkey:
        return keyframe
    raise ValueError(f"keyframe must be one of {names or 'none'} in this scene, got {keyframe!r}")


def rollout(
    scene: Scene,
    state: State,
    controls: Float[ArrayLike, "_ _"] | Policy | None = None,
    params: PyTree = None,
    noise: Float[ArrayLike, "_ _"] | None = None,
    *,
    horizon: int | None = None,
    observe: Observe | None = None,
    policy_sees: Sees = "state",
    checkpoint: bool = True,
    gradient: Gradient = "discrete",
    onset: Onset | None = None,
    smoothing: Smoothing | None = None,
    velocity_limit: float | None = 1e4,
    measure_growth: bool = False,
    inputs: Mapping[str, Float[ArrayLike, "..."]] | None = None,
    engine: Engine | None = None,
) -> Trajectory:
    """Step a scene many times.

    Batches are `jax.vmap` over any argument. Differentiable both ways; a rollout that diverged has no meaningful
    derivative, and `diverged` says so.

    Args:
        scene: from `load_scene`.
        state: where to begin, from `initial_state` or the end of another rollout.
        controls: one row per step; or a policy, called as `policy(params, state)`; or None for the scene's resting ones.
            Beyond an actuator's `ctrlrange` a control has the effect of its end, and derivative zero.
        params: handed to the policy.
        noise: added to the controls, one row per step.
        horizon: number of steps; needed only where neither controls nor noise give it.
        observe: called as `observe(model, data)` with the data of every state, all positions, contacts and forces filled
            in; its results are stacked. Name what you need: what it does not return is not kept. `mg.sensor`,
            `mg.site_position` and `mg.contact_force` read things by name.
        policy_sees: "state", or "observations": the policy is then called with what `observe` returns in place of the state.
            It looks before it chooses: forces and accelerations are those under the control before, in the first step under the
            scene's resting one. This takes a second solve per step where they are observed.
        checkpoint: recompute each step in reverse mode and keep only its state and the solutions of its solves, so that memory
            grows by a few numbers per step. Off, everything is kept: somewhat faster, and hundreds of times larger.
        gradient: "discrete", the derivative of each step, which finite differences of it give; or "slope", which knows that
            contacts and limits begin and end at times that move, so that its mean is the slope of the outcome. The motion is the
            same. Of C MuJoCo's step see `native.events`, of MJX's `step`.
        onset: lets contacts and limits begin within the step, see `step`: a continuous motion, whose plain derivative is the
            slope. None is MuJoCo's motion, to the bit.
        smoothing: averages the contacts of each step over noise on their distance, see `step`. It is said by a
            `SceneWarning` what of the scene it has no effect on.
        velocity_limit: a generalised speed beyond it counts as diverged (m/s, rad/s); None switches this off.
        measure_growth: carry one tangent along and tell by `growth` and `explodes` whether derivatives of this rollout can be
            believed: contacts that chatter may multiply them at every switch. It takes as long as a derivative in forward mode.
        inputs: what else is given to each step, one row per step, by MuJoCo's names: `qfrc_applied`, `xfrc_applied`,
            `mocap_pos`, `mocap_quat`, `eq_active`. Differentiable, but for the last. What is not named stays as in `scene.data`.
        engine: "mjx" or "mujoco": C MuJoCo on all cores of the processor, with nothing to compile, differentiable once. Its
            motion has no onset, to the solver's tolerance; what has no meaning there is refused. None is the scene's own,
            `scene.engine`.

    Returns:
        The trajectory, with `horizon + 1` states.

    Raises:
        ValueError: if there is no such gradient, it does not go with onset or smoothing, shapes do not fit the scene, the
            horizon is missing or contradicted, or controls or noise hold numbers that are not finite (checked where
            values are known, that is outside `jax.jit`; inside, the rollout is flagged as diverged at that step).
    """
    _check_scene(scene)
    if not isinstance(state, State):
        raise ValueError(f"state must be of mg.initial_state, or the end of a rollout, got {type(state).__name__}")
    check_gradient(gradient, onset, smoothing)
    for message in [] if smoothing is None else smoothing_warnings(smoothing, scene.model):
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    if policy_sees not in ("state", "observations") or (policy_sees == "observations" and observe is None):
        raise ValueError(
            f'policy_sees must be "state", or "observations" with observe=, got {policy_sees!r}, {observe=}'
        )
    nu = scene.model.nu
    sequence = None if controls is None or callable(controls) else jnp.asarray(controls)
    horizon = _horizon(horizon, controls=sequence, noise=noise)
    for name, value in (("controls", sequence), ("noise", noise)):
        if value is not None:
            _check_sequence(name, jnp.asarray(value), (horizon, nu))
    for name, size in (("qpos", scene.model.nq), ("qvel", scene.model.nv), ("act", scene.model.na)):
        if (shape := jnp.shape(getattr(state, name))) != (size,):
            remedy = "map over batches with jax.vmap"
            raise ValueError(f"state.{name} must have shape ({size},) in this scene, got {shape}: {remedy}")
    applied = _applied(scene, inputs, horizon)
    engine = scene.engine if engine is None else engine
    if engine != "mjx":
        given = {"observe": observe, "onset": onset, "smoothing": smoothing}
        _check_engine(engine, [name for name, value in given.items() if value is not None])
        base = None if callable(controls) else scene.data.ctrl if sequence is None else sequence
        added = jnp.zeros((horizon, nu), state.qvel.dtype) if noise is None else jnp.asarray(noise)
        chosen = controls if base is None else base + added
        found = _by_mujoco(scene, state, chosen, params, added, applied, gradient, velocity_limit)  # pyright: ignore[reportArgumentType]
        growth = _native_growth(scene, state, found.ctrl, applied, gradient) if measure_growth else None
        return dataclasses.replace(found, growth=growth)
    scene.check_mjx()
    policy = controls if callable(controls) else None
    resting = jnp.broadcast_to(scene.data.ctrl, (horizon, nu))
    base = resting if sequence is None else sequence
    rows = (base, jnp.zeros_like(base) if noise is None else noise, applied)
    settings = {"onset": onset, "smoothing": smoothing}
    how = (policy_sees, checkpoint, gradient, settings, velocity_limit, measure_growth)
    # Functions may read what changes from call to call: they are traced anew in each, unless the caller compiles.
    if policy is None and observe is None:
        return _rolled_out_compiled(scene, state, rows, None, None, None, how)
    return _rolled_out(scene, state, rows, policy, params, observe, how)


def _rolled_out(scene, state, rows, policy, params, observe, how) -> Trajectory:
    """Return what `rollout` does, once all of its arguments are known to be right."""
    policy_sees, checkpoint, gradient, settings, velocity_limit, measure_growth = how
    onset, smoothing, (horizon, nu) = settings["onset"], settings["smoothing"], rows[0].shape
    applied = rows[2]
    has_stages = scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4

    def look(state: State, ctrl: Array, forces: dict, stepped: mjx.Data | None = None) -> PyTree:
        if observe is None:
            return None
        data = data_of(scene, state, ctrl).replace(**forces)
        if stepped is None or has_stages:  # what a step of several stages leaves is of its last
            return observe(scene.model, forward(scene.model, data, **settings))
        at_start = {name: getattr(data, name) for name in ("qpos", "qvel", "act", "time")}
        return observe(scene.model, stepped.replace(**at_start))

    def advance(carry: tuple, given: tuple[Array, Array, Array, dict]):
        state, before, first_bad, unsolved, crowded, tangent, growth = carry
        index, row, disturbance, forces = given
        seen = None if before is None else look(state, before, forces)
        chosen = row if policy is None else _one_each(policy(params, state if before is None else seen), nu)
        ctrl = chosen + disturbance
        data = data_of(scene, state, ctrl).replace(**forces)
        if measure_growth:

            def take(qpos: Array, qvel: Array) -> tuple[tuple[Array, Array], mjx.Data]:
                stepped = step(scene.model, data.replace(qpos=qpos, qvel=qvel), gradient=gradient, **settings)
                return (stepped.qpos, stepped.qvel), stepped

            _, tangent, stepped = jax.jvp(take, (state.qpos, state.qvel), tangent, has_aux=True)
            tangent = jax.lax.stop_gradient(tangent)
            growth = jnp.maximum(growth, jnp.linalg.norm(jnp.concatenate(tangent)))  # a NaN stays one
        else:
            stepped = step(scene.model, data, gradient=gradient, **settings)
        moved = state_of(stepped)
        is_bad = ~is_sound(moved, velocity_limit)
        first_bad = jnp.where((first_bad < 0) & is_bad, index, first_bad)
        kept = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, moved)
        unsolved += (first_bad < 0) & (stepped._impl.solver_niter > scene.model.opt.iterations)
        crowded += (first_bad < 0) & _is_crowded(scene.model, jax.lax.stop_gradient(stepped), onset, smoothing)
        shown = None if before is None else ctrl.astype(before.dtype)
        carry = (kept, shown, first_bad, unsolved, crowded, tangent, growth)
        return carry, (state.qpos, state.qvel, state.act, ctrl, look(state, ctrl, forces, stepped), seen)

    if checkpoint:
        keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
        # Inside a scan nothing can be merged across the barrier that prevent_cse would put up.
        advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
    policy_looks = policy is not None and policy_sees == "observations"
    start = (
        state,
        scene.data.ctrl if policy_looks else None,  # the control before, under which a policy looks
        jnp.where(_has_numbers(scene), jnp.int32(-1), jnp.int32(0)),
        jnp.zeros((), jnp.int32),
        jnp.zeros((), jnp.int32),
        _direction(state) if measure_growth else None,
        jnp.ones((), state.qvel.dtype) if measure_growth else None,
    )
    (final, _, first_bad, unsolved, crowded, _, growth), (qpos, qvel, act, ctrl, observed, seen) = jax.lax.scan(
        advance,
        start,
        (jnp.arange(horizon, dtype=jnp.int32), *rows),  # pyright: ignore[reportArgumentType]
    )
    if observe is not None:
        last = look(final, ctrl[-1], jax.tree.map(lambda x: x[-1], applied))
        observed = jax.tree.map(lambda x, y: jnp.concatenate([x, jnp.asarray(y)[None]]), observed, last)
    return Trajectory(
        qpos=jnp.concatenate([qpos, final.qpos[None]]),
        qvel=jnp.concatenate([qvel, final.qvel[None]]),
        ctrl=ctrl,
        observations=observed,
        final=final,
        diverged=first_bad >= 0,
        first_bad_step=first_bad,
        unsolved=unsolved,
        crowded=crowded,
        growth=None if growth is None else jnp.where(jnp.isnan(growth), jnp.inf, growth),
        act=jnp.concatenate([act, final.act[None]]),
        seen=seen,
    )


_rolled_out_compiled = compiled(_rolled_out)


def _check_scene(scene: Any) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"scene must be of mg.load_scene, got {type(scene).__name__}")


def _one_each(chosen: Any, num_controls: int) -> Float[Array, " nu"]:
    """Refuse what a policy chose unless it is one control per actuator: others would be added up, or shared out, in silence."""
    chosen = jnp.asarray(chosen) if isinstance(chosen, list) else chosen
    if not eqx.is_array_like(chosen) or jnp.shape(chosen) != (num_controls,):
        raise ValueError(
            f"the policy must return one control per actuator, shape ({num_controls},), got {form(chosen)}"
        )
    return jnp.asarray(chosen)


def _has_numbers(scene: Scene) -> Bool[Array, ""]:
    """Whether what only the running program knows of a model are numbers: a contact of NaN would not be felt at all."""
    traced = [x for x in numbers_of(scene.model).values() if isinstance(x, jax.core.Tracer)]
    return jnp.array(True) if not traced else ~jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in traced]))


def _applied(scene: Scene, inputs: Mapping[str, ArrayLike] | None, horizon: int) -> dict[str, Array]:
    """Return what is given to each step besides controls, or refuse what there is not."""
    found = {}
    for name, value in ({} if inputs is None else inputs).items():
        if name not in INPUTS[1:]:
            raise ValueError(f"inputs must be among {', '.join(INPUTS[1:])}, got {name!r}")
        shape = (horizon, *getattr(scene.data, name).shape)
        if np.shape(value) != shape:
            raise ValueError(f"inputs[{name!r}] must have shape {shape}, one row per step, got {np.shape(value)}")
        found[name] = jnp.asarray(value, getattr(scene.data, name).dtype)
    return found


def _check_engine(engine: str, given: list[str]) -> None:
    if engine != "mujoco":
        raise ValueError(f'engine must be "mjx" or "mujoco", got {engine!r}')
    if given:
        raise ValueError(f'engine="mujoco" is MuJoCo\'s own motion, got {" and ".join(given)}: leave it out')


def _by_mujoco(
    scene: Scene,
    state: State,
    controls: Policy | Float[Array, "horizon nu"],
    params: PyTree,
    noise: Float[Array, "horizon nu"],
    applied: dict[str, Array],
    gradient: Gradient,
    velocity_limit: float | None,
) -> Trajectory:
    """Return what C MuJoCo makes of controls, noise included, or of a policy; from the first bad step on the last good state."""
    if not callable(controls):
        return _native_course(scene, state, controls, applied, gradient, velocity_limit)

    def advance(carry: tuple[State, Array], given: tuple[Array, Array, dict]) -> tuple:
        state, first_bad = carry
        index, disturbance, forces = given
        ctrl = _one_each(controls(params, state), scene.model.nu) + disturbance
        forces = jax.tree.map(lambda x: x[None], forces)
        one = _native_course(scene, state, ctrl[None], forces, gradient, velocity_limit)
        first_bad = jnp.where((first_bad < 0) & one.diverged, index, first_bad)
        moved = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, one.final)
        return (moved, first_bad), (state, ctrl)

    steps = jnp.arange(len(noise), dtype=jnp.int32)
    (final, first_bad), (states, ctrl) = jax.lax.scan(advance, (state, jnp.int32(-1)), (steps, noise, applied))
    return _course(jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), states, final), ctrl, first_bad)


@eqx.filter_jit
def _native_course(
    scene: Scene,
    state: State,
    ctrl: Float[Array, "horizon nu"],
    applied: dict[str, Array],
    gradient: Gradient,
    velocity_limit: float | None,
) -> Trajectory:
    start = {"time": jnp.asarray(state.time)[None], "qpos": state.qpos, "qvel": state.qvel, "act": state.act}
    is_finite = jnp.isfinite(ctrl)  # MuJoCo takes another for zero
    given = {
        name: jnp.broadcast_to(getattr(scene.data, name), (len(ctrl), *getattr(scene.data, name).shape))
        for name in INPUTS[1:]
        if getattr(scene.data, name).size
    }
    found = roll_out(scene, start, given | applied | {"ctrl": jnp.where(is_finite, ctrl, 0.0)}, gradient)
    qpos, qvel, act = (
        jnp.concatenate([first[None], rest])
        for first, rest in zip((state.qpos, state.qvel, state.act), found, strict=True)
    )
    time = state.time + scene.model.opt.timestep * jnp.arange(len(ctrl) + 1)
    states = jax.vmap(State)(qpos, qvel, act, time, jnp.zeros_like(qvel))
    is_bad = ~(jax.vmap(lambda one: is_sound(one, velocity_limit))(states)[1:] & jnp.all(is_finite, axis=1))
    first_bad = jnp.where(jnp.any(is_bad), jnp.argmax(is_bad).astype(jnp.int32), -1)
    kept = jnp.arange(len(ctrl) + 1)
    kept = jnp.where(first_bad >= 0, jnp.minimum(kept, first_bad), kept)
    return _course(jax.tree.map(lambda x: x[kept], states), ctrl, first_bad)


def _course(states: State, ctrl: Float[Array, "horizon nu"], first_bad: Int[Array, ""]) -> Trajectory:
    final = jax.tree.map(lambda x: x[-1], states)
    return Trajectory(states.qpos, states.qvel, ctrl, None, final, first_bad >= 0, first_bad, act=states.act)  # pyright: ignore[reportCallIssue]


def _native_growth(
    scene: Scene, state: State, ctrl: Array, applied: dict[str, Array], gradient: Gradient
) -> Float[Array, ""]:
    """Return how many times longer a change of the start becomes; it has no derivative."""
    given = (scene, state, ctrl, applied)
    scene, state, ctrl, applied = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, given
    )

    def course(qpos: Array, qvel: Array) -> tuple[Array, Array]:
        start = dataclasses.replace(state, qpos=qpos, qvel=qvel)
        found = _native_course(scene, start, ctrl, applied, gradient, None)
        return found.qpos, found.qvel

    _, change = jax.jvp(course, (state.qpos, state.qvel), _direction(state))
    size = jnp.linalg.norm(jnp.concatenate(change, axis=1), axis=1).max()
    return jnp.where(jnp.isfinite(size), jnp.maximum(size, 1.0), jnp.inf)


def _is_crowded(model: mjx.Model, data: mjx.Data, onset: Onset | None, smoothing: Smoothing | None) -> Bool[Array, ""]:
    """Return whether, in the step that the data is from, contacts may have acted that found no slot."""
    if not data._impl.ncon or slot_geoms(model, data) is not None:
        return jnp.array(False)
    if smoothing is not None:
        return jnp.array(True)
    return first_missed(model, data) < (0.0 if onset is None else reach(model, data, onset))


def _direction(state: State) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """Return a change of the start of length one, the same for every rollout of a scene."""
    random = np.random.default_rng(0)
    parts = (random.normal(size=state.qpos.shape), random.normal(size=state.qvel.shape))
    size = np.sqrt(sum((part**2).sum() for part in parts))
    return tuple(jnp.asarray(part / size, state.qvel.dtype) for part in parts)  # pyright: ignore[reportReturnType]


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
        qpos=state.qpos, qvel=state.qvel, act=state.act, time=state.time, qacc_warmstart=state.warmstart, ctrl=ctrl
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


def pose_warnings(model: mjx.Model, of_file: mujoco.MjModel | None, qpos: ArrayLike) -> Iterator[str]:
    """Say what is wrong with a known pose: joints beyond their limits and, of one that a file has, geoms deep in others.

    Raises:
        ValueError: if a quaternion is zero.
    """
    pose, ranges = known(qpos), known(model.jnt_range)
    if pose is None or ranges is None or pose.shape != (model.nq,) or ranges.shape != (model.njnt, 2):
        return
    units = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}
    has_limits = not model.opt.disableflags & _NO_LIMITS
    for joint, (kind, first) in enumerate(zip(model.jnt_type, model.jnt_qposadr, strict=True)):
        value, (low, high) = pose[first], ranges[joint]
        quaternion = pose[first + 3 * (kind == mujoco.mjtJoint.mjJNT_FREE) :][:4]
        slack = 1e-6 * max(1.0, abs(value))  # single precision's rounding
        is_within = (
            kind not in units or not has_limits or not model.jnt_limited[joint] or low - slack <= value <= high + slack
        )
        if is_within and (kind in units or quaternion.any()):
            continue
        name = mjx.id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"joint {joint}"
        if is_within:
            raise ValueError(
                f"qpos must have a quaternion that is not zero, got zeros for {name}; no turn is 1, 0, 0, 0"
            )
        unit = units[int(kind)]
        yield f"{name} begins at {value:g} {unit}, beyond its range from {low:g} to {high:g} {unit}"
    if of_file is None:
        return
    data = mujoco.MjData(of_file)
    data.qpos[:] = pose
    mujoco.mj_fwdPosition(of_file, data)
    deepest = min(data.contact, key=lambda contact: contact.dist, default=None)
    if deepest is not None and deepest.dist < -_DEEP:
        names = " in ".join(geom_name(of_file, geom) for geom in deepest.geom[::-1].tolist())
        yield f"{names} begins {-1e3 * deepest.dist:.3g} mm deep: give qpos or keyframe"


def _horizon(horizon: int | None, **sequences: ArrayLike | None) -> int:
    lengths = {k: int(jnp.shape(v)[0]) for k, v in sequences.items() if v is not None and jnp.ndim(v)}
    if horizon is not None:
        lengths["horizon"] = whole("horizon", horizon)
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
        meaning = "one row per step and one column per actuator"
        raise ValueError(f"{name} must have shape {shape}, {meaning}, got {value.shape}")
    numbers = known(value)  # not jnp, whose operations are traced inside jit even on known values
    if numbers is None or np.isfinite(numbers).all():
        return
    row, column = np.argwhere(~np.isfinite(numbers))[0]
    raise ValueError(f"{name} must be finite, got {numbers[row, column]} in step {row} for actuator {column}")
