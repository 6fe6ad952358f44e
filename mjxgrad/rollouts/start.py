"""Initial states, and checks of a pose."""

import warnings
from collections.abc import Iterator

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import ArrayLike, Float

from mjxgrad._arrays import is_known, known, real
from mjxgrad._mjx import mjx
from mjxgrad.contact.parameters import geom_name
from mjxgrad.engines import engine_of
from mjxgrad.engines.state import State, check_scene
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.stepping import Discrete

_HARMLESS = 0.01  # share of its range by which a joint may begin beyond it
_DEEP = 0.02  # m, largest penetration of a pose without a warning
_NO_LIMITS = mujoco.mjtDisableBit.mjDSBL_LIMIT.value | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value


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
    beyond its limits, which would push it back from the first step, and about deep penetration.

    Raises:
        ValueError: if a part does not fit the scene's shapes, is not finite, has a zero quaternion, or there is no such key
            frame.
    """
    check_scene(scene)
    data, keys, parts, time = scene.data, {}, [], 0.0
    if keyframe is not None:
        key = key_of(scene.mj_model, keyframe)
        time = scene.mj_model.key_time[key]
        keys = {name: getattr(scene.mj_model, f"key_{name}")[key] for name in ("qpos", "qvel", "act")}
    for name, given in (("qpos", qpos), ("qvel", qvel), ("act", act)):
        template = getattr(data, name)
        part = real(name, keys.get(name, template) if given is None else given, template.dtype)
        if part.shape != template.shape:
            raise ValueError(f"{name} must have shape {template.shape} in this scene, got {part.shape}")
        if is_known(part) and not np.isfinite(part).all():
            bad = np.flatnonzero(~np.isfinite(part))
            where = f"{np.asarray(part)[bad[0]]} at {bad[0]}" + f" and {len(bad) - 1} more" * (len(bad) > 1)
            raise ValueError(f"{name} must be finite, got {where}")
        parts.append(part)
    for message in pose_warnings(scene.model, scene.mj_model, parts[0]):
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    state = State(*parts, time=jnp.full_like(data.time, time), warmstart=jnp.zeros_like(data.qvel))
    return engine_of(scene).complete(scene, state, Discrete())


def key_of(model: mujoco.MjModel, keyframe: str | int) -> int:
    """Return the index of a key frame; refuse one that is not there."""
    names = [model.key(i).name or i for i in range(model.nkey)]
    if keyframe in names:
        return names.index(keyframe)
    if isinstance(keyframe, int) and 0 <= keyframe < model.nkey:
        return keyframe
    if not names:
        raise ValueError(f"keyframe must be None, for this scene has none, got {keyframe!r}")
    raise ValueError(f"keyframe must be one of {names} in this scene, got {keyframe!r}")


def pose_warnings(model: mjx.Model, of_file: mujoco.MjModel, qpos: ArrayLike) -> Iterator[str]:
    """Return warnings about a known pose: joints beyond their limits, and deep penetration.

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
    data = mujoco.MjData(of_file)
    data.qpos[:] = pose
    mujoco.mj_fwdPosition(of_file, data)
    deepest = min(data.contact, key=lambda contact: contact.dist, default=None)
    if deepest is not None and deepest.dist < -_DEEP:
        names = " in ".join(geom_name(of_file, geom) for geom in deepest.geom[::-1].tolist())
        yield f"{names} begins {-1e3 * deepest.dist:.3g} mm deep: begin elsewhere, by qpos or keyframe"
