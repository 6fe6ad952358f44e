"""States and trajectories, initial states, and checks of a pose and of a rollout."""

import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from mjxgrad._arrays import instance, is_known, known, real
from mjxgrad._mjx import mjx
from mjxgrad.contact.parameters import geom_name
from mjxgrad.engines import MOTION, engine_of
from mjxgrad.scene import Scene, SceneWarning

VELOCITY_LIMIT = 1e4  # m/s or rad/s, beyond which a rollout counts as diverged
_HARMLESS = 0.01  # share of its range by which a joint may begin beyond it
_DEEP = 0.02  # m, largest penetration of a pose without a warning
_NO_LIMITS = mujoco.mjtDisableBit.mjDSBL_LIMIT.value | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value
LARGEST_GROWTH = 1e3
"""Growth of a tangent that counts as exploding. In half a second of free motion 1 m/s becomes 0.5 m; a bounce reduces it."""


class Pairs(eqx.Module):
    """Pairs of motions that a slope by C MuJoCo follows, see `engines.flight`; empty where nothing is differentiated.

    Attributes:
        flight: both motions of each, as changes of the state, how far apart they began, and how they are followed.
        held: zeros, whose derivative is what each pair has felt of a change.
    """

    flight: Float[Array, "slots numbers"]
    held: Float[Array, " slots"]


class State(eqx.Module):
    """The state before a step.

    Attributes:
        qpos: generalised positions (m, rad, unit quaternions).
        qvel: generalised velocities (m/s, rad/s).
        act: actuator activations.
        time: simulated time (s).
        warmstart: acceleration at which the next solve starts. It affects the solve's duration, not its result.
        history: past controls and readings, of delays, and states of plugins; as MuJoCo keeps them.
        pairs: pairs of motions that a slope by C MuJoCo follows; None where MJX steps the scene.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]
    time: Float[Array, ""]
    warmstart: Float[Array, " nv"]
    history: Float[Array, " nhistory"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    pairs: Pairs | None = None


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


def initial_state(
    scene: Scene,
    qpos: Float[ArrayLike, " nq"] | None = None,
    qvel: Float[ArrayLike, " nv"] | None = None,
    act: Float[ArrayLike, " na"] | None = None,
    *,
    keyframe: str | int | None = None,
) -> State:
    """Return the state at the scene's reference pose, at rest, or at a key frame, with the given parts replaced.

    The parts are those of `State`. A key frame of the file has a name or number. Where values are known, it warns about a joint
    beyond its limits, which would push it back from the first step, and about deep penetration in a pose of the file.

    Raises:
        ValueError: if a part does not fit the scene's shapes, is not finite, has a zero quaternion, or there is no such key
            frame.
    """
    check_scene(scene)
    data, keys, parts = scene.data, {}, []
    if keyframe is not None:
        key = _keyframe(scene.mj_model, keyframe)
        keys = {name: getattr(scene.mj_model, f"key_{name}")[key] for name in ("qpos", "qvel", "act")}
    for name, given in (("qpos", qpos), ("qvel", qvel), ("act", act)):
        template = getattr(data, name)
        part = real(name, keys.get(name, template) if given is None else given, template.dtype)
        if part.shape != template.shape:
            raise ValueError(f"{name} must have shape {template.shape} in this scene, got {part.shape}")
        if is_known(part) and not np.isfinite(part).all():
            raise ValueError(f"{name} must be finite, got {np.asarray(part).tolist()}")
        parts.append(part)
    for message in pose_warnings(scene.model, scene.mj_model if qpos is None else None, parts[0]):
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    state = State(*parts, time=jnp.zeros_like(data.time), warmstart=jnp.zeros_like(data.qvel))
    return complete(scene, state) if scene.engine == "mujoco" else state


def complete(scene: Scene, state: State) -> State:
    """Return a state with all that C MuJoCo goes on with: histories as they are at first, no pairs, unless it has some."""
    engine, dtype = engine_of(scene.mj_model), state.qpos.dtype
    first = np.concatenate([engine.first[name] for name in MOTION[3:]])
    history = state.history if state.history.size == first.size else jnp.asarray(first, dtype)
    nothing = [jnp.zeros(shape, dtype) for shape in (engine.flight_shape, engine.flight_shape[:1])]
    pairs = Pairs(*nothing) if state.pairs is None else state.pairs
    return dataclasses.replace(state, history=history, pairs=pairs)


def _keyframe(model: mujoco.MjModel, keyframe: str | int) -> int:
    names = [model.key(i).name or i for i in range(model.nkey)]
    if keyframe in names:
        return names.index(keyframe)
    if isinstance(keyframe, int) and 0 <= keyframe < model.nkey:
        return keyframe
    if not names:
        raise ValueError(f"keyframe must be None, for this scene has none, got {keyframe!r}")
    raise ValueError(f"keyframe must be one of {names} in this scene, got {keyframe!r}")


def pose_warnings(model: mjx.Model, of_file: mujoco.MjModel | None, qpos: ArrayLike) -> Iterator[str]:
    """Return warnings about a known pose: joints beyond their limits and, for poses of the file, deep penetration.

    Raises:
        ValueError: if a quaternion is zero.
    """
    pose, ranges = known(qpos), known(model.jnt_range)
    if pose is None or ranges is None or pose.shape != (model.nq,) or ranges.shape != (model.njnt, 2):
        return
    units = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}
    has_limits = not model.opt.disableflags & _NO_LIMITS
    for joint, (kind, first) in enumerate(zip(model.jnt_type, model.jnt_qposadr, strict=True)):
        name = mjx.id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"joint {joint}"
        if kind not in units:
            if not pose[first + 3 * (kind == mujoco.mjtJoint.mjJNT_FREE) :][:4].any():
                raise ValueError(f"qpos must have a quaternion that is not zero, got zeros for {name}")
        elif has_limits and model.jnt_limited[joint]:
            unit, value, (low, high) = units[int(kind)], pose[first], ranges[joint]
            # Single precision's rounding; noise of starts.
            slack = 1e-6 * max(1.0, abs(value)) + _HARMLESS * (high - low)
            if not low - slack <= value <= high + slack:
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
    """Refuse what is no scene."""
    instance("scene", scene, Scene, "of mg.load_scene")


class DivergedError(FloatingPointError):
    """A rollout left the range in which its numbers mean anything."""
