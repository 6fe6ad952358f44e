"""Measured motions of a scene, and their batch."""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjxgrad._arrays import instance, positive, real
from mjxgrad._mjx import mjx
from mjxgrad.bodies.tree import joint_runs
from mjxgrad.engines import engine_of
from mjxgrad.rollouts import State, initial_state
from mjxgrad.rollouts.rollout import clamped
from mjxgrad.scene import Scene, SceneWarning, sensor
from mjxgrad.stepping import Discrete

STATES = ("qpos", "qvel", "act")
_AROUND = 2  # rows on each side that tell a speed
_FAR = 10.0  # times the noise by which a first row parts from an exact start that is told
_WILD = 1e4  # m/s or rad/s, more than which nothing moves that is worth identifying
_SAME = 0.01  # of a time step, within which two times are one: they may be given with seven digits
_TURN, _BEYOND = 2 * np.pi, 0.1  # rad, more than which may be degrees; share of its range by which a joint may leave it


@dataclasses.dataclass(frozen=True)
class Recording:
    """A measured motion.

    Attributes:
        measured: measurements by sensor name, or as "qpos", "qvel" or "act": one row per time, NaN for none.
        controls: the controls, one row per time step of the scene or per entry of `control_times`; None without actuators.
        times: times of the measurements from the start (s), increasing; None for one at each state.
        control_times: times of the controls (s), which are then interpolated linearly; None for one row per time step. They
            reach over the whole motion; the first and the last row may be held for one interval.
        noise: standard deviation of each signal in its own unit, one number or one per column; "qpos" has one per velocity
            (m, rad). The default is 1.
        start: the state at time 0; None for what was measured then, else the scene's pose, at rest.
        name: name in messages.
        knows_noise: whether `noise` is that of the measurements; otherwise it only weighs the signals.
    """

    measured: Mapping[str, Any]
    controls: Any = None
    times: Any = None
    control_times: Any = None
    noise: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    start: State | None = None
    name: str = "the recording"
    knows_noise: bool = True

    def __post_init__(self):
        for name in ("measured", "noise"):
            instance(f"{name} of {self.name}", getattr(self, name), Mapping, 'a dict by signal, such as {"qpos": ...}')
        of = f"of {self.name}"
        rows = {name: np.asarray(real(f"{name} {of}", value), float) for name, value in self.measured.items()}
        if not all(isinstance(name, str) and 1 <= v.ndim <= 2 for name, v in rows.items()):
            given = {name: v.shape for name, v in rows.items()}
            raise ValueError(f"measured {of} must hold one row per time, by name, got shapes {given}")
        for name in ("controls", "times", "control_times"):
            if (value := getattr(self, name)) is None:
                continue
            value = np.asarray(real(f"{name} {of}", value), float)
            is_rows = value.ndim in ((1, 2) if name == "controls" else (1,)) and len(value) > 0
            if not (is_rows and np.isfinite(value).all()):
                raise ValueError(f"{name} {of} must be finite, one row per time, got {value}")
            if name != "controls" and (np.any(np.diff(value) <= 0) or np.any(value < 0)):
                raise ValueError(f"{name} {of} must increase from 0 or later, got {value}")
        object.__setattr__(self, "measured", {k: v[:, None] if v.ndim == 1 else v for k, v in rows.items()})
        counts = {name: len(v) for name, v in rows.items()} | ({} if self.times is None else {"times": len(self.times)})
        lengths = set(counts.values())
        if not rows or 0 in lengths:
            raise ValueError(f"measured {of} must hold at least one row of some signal, got {counts or 'none'}")
        if len(lengths) > 1:
            raise ValueError(f"measured and times {of} must have the same number of rows, got {counts}")
        if infinite := [name for name, v in rows.items() if np.isinf(v).any()]:
            raise ValueError(f"measured {of} must be finite, or NaN for none, got infinity in {', '.join(infinite)}")
        count = len(self.controls) if self.controls is not None else None
        if self.control_times is not None and len(self.control_times) != count:
            given = f"{len(self.control_times)} times and {count or 'no'} rows"
            raise ValueError(f"control_times {of} must have one time per row of controls, got {given}")
        if count is not None and self.times is None and self.control_times is None and lengths != {count + 1}:
            needed = f"{count + 1} rows for {count} controls, one at each state, or times"
            raise ValueError(f"measured {of} must have {needed}, got {max(lengths)}: NaN fills gaps")
        instance(f"start {of}", self.start, State | None, "of mg.initial_state")
        if unknown := set(self.noise) - set(rows):
            raise ValueError(f"noise {of} must name measured signals, got {sorted(map(str, unknown))}")
        for name, value in self.noise.items():
            noise = np.asarray(real(f"noise of {name}", value))
            if noise.ndim > 1 or not (noise > 0).all():
                raise ValueError(f"noise of {name} {of} must be positive, or inf for no weight, got {value}")

    def __repr__(self) -> str:
        parts = [f"{name} {value.shape}" for name, value in self.measured.items()]
        parts += [f"controls {np.shape(self.controls)}" if self.controls is not None else "no controls"]
        parts += [f"{float(self.times[-1]):.4g} s"] if self.times is not None else ["one row per time step"]
        return f"Recording({self.name!r}: {', '.join(parts)})"

    def cut(self, duration: float, timestep: float) -> list["Recording"]:
        """Return windows of a duration (s) at the scene's time step (s), each from a measured state; the rest is dropped.

        `identify` needs none: its horizon grows by itself. Windows are as noisy at their starts as the measurements, so that on
        a floor each begins with a small bounce, which biases friction. Speeds that were not measured are the mean ones of a few
        rows, for joints of one number each.

        Raises:
            ValueError: if positions were not measured, no window fits, controls are missing, or a number is not positive.
        """
        if "qpos" not in self.measured:
            raise ValueError(f"{self.name} must have measured qpos to be cut, got {sorted(self.measured)}")
        positive("duration", duration)
        positive("timestep", timestep)
        measured, noise, times = dict(self.measured), dict(self.noise), _times(self, timestep)
        begins = np.arange(times[0], times[-1] - duration + timestep / 2, duration)
        if not begins.size:
            raise ValueError(f"duration must be at most that of {self.name}, {times[-1]:g} s, got {duration:g} s")
        if "qvel" not in measured:
            # MuJoCo's speed of a step is that which led to its place: half a step before.
            half = _AROUND * float(np.median(np.diff(times)))
            first, last = (np.clip(times - timestep / 2 + way, times[0], times[-1]) for way in (-half, half))
            places = [np.stack([np.interp(at, times, x) for x in measured["qpos"].T], axis=1) for at in (first, last)]
            measured["qvel"] = (places[1] - places[0]) / (last - first)[:, None]
            noise["qvel"] = 1 / half * np.broadcast_to(noise.get("qpos", 1.0), measured["qpos"].shape[1:])
        controls, at = self.controls, self.control_times
        if controls is not None:
            at = timestep * np.arange(len(controls)) if at is None else np.asarray(at, float)
            _check_covered(self, at, times[-1], timestep)
        windows = []
        for begin in begins:
            rows = np.flatnonzero((times >= begin - timestep / 2) & (times <= begin + duration + timestep / 2))
            if len(rows) < 2:  # in a gap, where nothing follows a start
                continue
            own = {name: value[rows] for name, value in measured.items()}
            if "qvel" not in self.measured:  # the start's alone counts: others follow from places
                own["qvel"] = np.where(np.arange(len(rows))[:, None] == 0, own["qvel"], np.nan)
            (start, end), name = times[rows[[0, -1]]], f"{self.name} from {times[rows[0]]:g} s"
            given = None, None
            if controls is not None and at is not None:
                # A window's ends lie between two rows of controls, as its steps do.
                inner = at[(at > start + _SAME * timestep) & (at < end - _SAME * timestep)]
                moments = np.unique([start, *inner, end])
                given = _interpolated(moments, at, controls), moments - start
            windows.append(Recording(own, given[0], times[rows] - start, given[1], noise, None, name, self.knows_noise))
        if not windows:
            raise ValueError(f"duration must be that of two rows of {self.name} at least, got {duration:g} s")
        return windows


class Windows(NamedTuple):
    """Recordings of one scene as a batch; shorter ones are padded by rows of weight zero.

    A measurement is a share of a step after the state with its index. Weights are 1 / noise, 0 where nothing was measured.
    """

    state: State
    controls: Float[np.ndarray, "windows steps nu"]
    index: Int[np.ndarray, "windows rows"]  # pyright: ignore[reportIncompatibleMethodOverride]
    share: Float[np.ndarray, "windows rows"]
    measured: dict[str, Float[np.ndarray, "windows rows _"]]
    weight: dict[str, Float[np.ndarray, "windows rows _"]]


def stack(scene: Scene, recordings: Sequence[Recording]) -> Windows:
    """Return the recordings of a scene as a batch.

    Raises:
        ValueError: if controls or signals do not have the scene's shapes, or measurements go beyond the controls.
    """
    timestep = float(scene.model.opt.timestep)
    steps = [_num_steps(one, timestep) for one in recordings]
    names = list(dict.fromkeys(name for one in recordings for name in one.measured))
    num_steps, num_rows = max(steps), max(len(_times(one, timestep)) for one in recordings)
    parts = [_window(scene, one, names, num_steps, num_rows) for one in recordings]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)


def _times(recording: Recording, timestep: float) -> np.ndarray:
    if recording.times is not None:
        return np.asarray(recording.times, float)
    return timestep * np.arange(len(next(iter(recording.measured.values()))))


def _num_steps(recording: Recording, timestep: float) -> int:
    """Return the number of steps up to the last measurement; refuse more than there are controls."""
    needed = max(1, int(np.ceil(_times(recording, timestep)[-1] / timestep - 1e-6)))
    if recording.controls is not None and recording.control_times is None and needed > len(recording.controls):
        name, given = recording.name, len(recording.controls)
        raise ValueError(f"controls of {name} must have a row for each of {needed} measured steps, got {given}")
    return needed


def _window(scene: Scene, recording: Recording, names: list[str], num_steps: int, num_rows: int) -> Windows:
    timestep = float(scene.model.opt.timestep)
    times = _times(recording, timestep)
    place = np.clip(times / timestep, 0, num_steps)
    index = np.minimum(np.floor(place + 1e-6).astype(int), num_steps - 1)
    spare = (0, num_rows - len(times))
    measured, weight = {}, {}
    for name in names:
        width = _width(scene, name)
        value = recording.measured.get(name, np.full((len(times), width), np.nan))
        if (given := value.shape[1]) != width:
            raise ValueError(f"{name} of {recording.name} must have {width} columns in this scene, got {given}")
        columns = scene.model.nv if name == "qpos" else width
        noise = np.asarray(recording.noise.get(name, 1.0), float)
        if noise.shape not in ((), (columns,)):
            wanted = f"one number or {columns} in this scene"
            raise ValueError(f"noise of {name} of {recording.name} must be {wanted}, got shape {noise.shape}")
        is_there = np.isfinite(value)
        if name == "qpos":
            value, given = np.where(is_there, value, np.asarray(scene.data.qpos)), is_there
            is_there = np.stack([given[:, one].all(axis=1) for one in coordinates(scene.model)], axis=1)
            if any(given[:, one].any() and not given[:, one].all(axis=1).any() for one in coordinates(scene.model)):
                raise ValueError(f"qpos of {recording.name} must have all four numbers of a quaternion, or none")
        weight[name] = np.pad(is_there / np.broadcast_to(noise, (columns,)), (spare, (0, 0)))
        measured[name] = np.pad(np.nan_to_num(value), (spare, (0, 0)), mode="edge")
    controls = _controls(scene, recording, num_steps, timestep)
    index, share = (np.pad(x, spare) for x in (index, place - index))
    return Windows(start_of(scene, recording, times), controls, index, share, measured, weight)


def spread(scene: Scene, recordings: Sequence[Recording], free_start: bool | None) -> Float[np.ndarray, "windows both"]:
    """Return the noise of each start, positions and velocities (m, rad, m/s, rad/s), where its numbers were measured.

    A start that was given is exact unless all starts are free.
    """
    found = np.zeros((len(recordings), 2, scene.model.nv))
    for spread, one in zip(found, recordings, strict=True):
        is_noisy = one.start is None if free_start is None else free_start
        for row, name in zip(spread, ("qpos", "qvel"), strict=True):
            if is_noisy and name in one.measured and _times(one, float(scene.model.opt.timestep))[0] == 0:
                is_there = np.isfinite(one.measured[name][0])
                if name == "qpos":
                    is_there = np.array([is_there[numbers].all() for numbers in coordinates(scene.model)])
                noise = np.asarray(one.noise.get(name, 1.0), float)
                row[:] = np.where(is_there & np.isfinite(noise), noise, 0.0)
    return found.reshape(len(recordings), -1)


def after_start(windows: Windows, spread: Float[np.ndarray, "windows both"]) -> Windows:
    """Return windows whose first rows do not count where the starts were read from them: their noise is that of the starts."""
    weight = dict(windows.weight)
    for name, noise in zip(("qpos", "qvel"), np.split(spread, 2, axis=1), strict=True):
        if name in weight:
            weight[name] = weight[name].copy()
            weight[name][:, 0] *= noise == 0
    return windows._replace(weight=weight)


def coordinates(model: mjx.Model | mujoco.MjModel) -> list[slice]:
    """Return for each velocity the numbers of a position that it changes: one, or all four of a quaternion."""
    found = []
    for run in joint_runs(model):
        turns = run.width > 1  # by a quaternion, whose four numbers are a joint's last
        for end in range(run.qpos.start + run.width, run.qpos.stop + 1, run.width):
            found += [slice(i, i + 1) for i in range(end - run.width, end - 4 * turns)] + [
                slice(end - 4, end)
            ] * 3 * turns
    return found


def _width(scene: Scene, name: str) -> int:
    if name in STATES:
        return getattr(scene.data, name).shape[0]
    return jax.eval_shape(lambda: sensor(scene.model, scene.data, name)).shape[0]


def start_of(scene: Scene, recording: Recording, times: np.ndarray) -> State:
    """Return the state at time 0: the given one, else the first row; missing parts are the scene's pose, at rest."""
    if recording.start is not None:
        if any(getattr(recording.start, name).shape != getattr(scene.data, name).shape for name in STATES):
            raise ValueError(f"start of {recording.name} must be a state of this scene, of mg.initial_state")
        # By the engine that simulates, which may be another than the state's.
        return engine_of(scene).complete(scene, dataclasses.replace(recording.start, pairs=None), Discrete())
    first = {name: recording.measured[name][0] for name in STATES if name in recording.measured and times[0] == 0}
    whole = {name: np.where(np.isfinite(row), row, getattr(scene.data, name)) for name, row in first.items()}
    with warnings.catch_warnings():
        if in_degrees(scene, recording):  # which `doubts` tells in one sentence
            warnings.simplefilter("ignore", SceneWarning)
        return initial_state(scene, **whole)


def doubts(scene: Scene, recording: Recording, free_start: bool | None) -> Iterator[str]:
    """Yield sentences on what a recording is perhaps not: a motion; in radians; from the exact start that was given."""
    model = scene.mj_model
    if (wild := _fastest(scene, recording)) > _WILD:
        yield f"something moves at {wild:.2g} m/s or rad/s: has a simulation blown up? Leave it out, or cut it before"
    if found := in_degrees(scene, recording):
        name, (angle, low, high) = next(iter(found.items()))
        others = f" (and {len(found) - 1} more)" * (len(found) > 1)
        yield (
            f"{name}{others} goes to {angle:.3g} rad, beyond its range from {low:.3g} to {high:.3g} rad: is it in degrees?"
        )
    if recording.start is None or free_start or _times(recording, float(scene.model.opt.timestep))[0] > 0:
        return
    apart = np.zeros((2, model.nv))
    begins = {name: np.asarray(getattr(recording.start, name), float) for name in ("qpos", "qvel")}
    rows = {name: recording.measured.get(name, begin[None])[0] for name, begin in begins.items()}
    rows = {name: np.where(np.isfinite(row), row, begins[name]) for name, row in rows.items()}
    mujoco.mj_differentiatePos(model, apart[0], 1.0, begins["qpos"], rows["qpos"])
    apart[1] = rows["qvel"] - begins["qvel"]
    apart = np.abs(apart) / [np.broadcast_to(recording.noise.get(name, 1.0), model.nv) for name in begins]
    dof = int(apart.max(axis=0).argmax())
    if apart[:, dof].max() > (_FAR if recording.knows_noise else 1.0):
        unit = "noise" if recording.knows_noise else "variation"
        what = f"{'speed' if apart[1, dof] > apart[0, dof] else 'place'} of {_joint_name(model, int(model.dof_jntid[dof]))}"
        yield (
            f"the first {what} is {apart[:, dof].max():.3g} times its {unit} beside the exact start that was given: "
            "is it of another pose?"
        )


def _fastest(scene: Scene, recording: Recording) -> float:
    """Return the largest speed that was measured, or that positions tell of (m/s, rad/s)."""
    times, fastest = _times(recording, float(scene.model.opt.timestep)), 0.0
    for name, signal in recording.measured.items():
        if name in STATES[:2] and len(signal) > 1:
            speeds = np.abs(signal if name == "qvel" else np.diff(signal, axis=0) / np.diff(times)[:, None])
            fastest = max(fastest, float(speeds.max(where=np.isfinite(speeds), initial=0.0)))
    return fastest


def in_degrees(scene: Scene, recording: Recording) -> dict[str, tuple[float, float, float]]:
    """Return the farthest angle and the range of hinges that would stay within their ranges if angles were in degrees."""
    model, found = scene.mj_model, {}
    if "qpos" not in recording.measured or recording.measured["qpos"].shape[1] != model.nq:
        return found
    for joint in np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited > 0)).tolist():
        angles, (low, high) = recording.measured["qpos"][:, model.jnt_qposadr[joint]], model.jnt_range[joint]
        angles, slack = angles[np.isfinite(angles)], _BEYOND * (high - low)
        turned = np.radians(angles)
        if np.abs(angles).max(initial=0.0) > _TURN and ((turned > low - slack) & (turned < high + slack)).all():
            found[_joint_name(model, joint)] = float(angles[np.abs(angles).argmax()]), float(low), float(high)
    return {name: one for name, one in found.items() if not one[1] <= one[0] <= one[2]}


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    return model.joint(joint).name or f"joint {joint}"


def _controls(scene: Scene, recording: Recording, num_steps: int, timestep: float) -> np.ndarray:
    name = recording.name
    if recording.controls is None and scene.model.nu:
        raise ValueError(f"controls of {name} must be given in a scene with actuators, zeros for rest, got none")
    if recording.controls is None:
        return np.broadcast_to(np.asarray(scene.data.ctrl), (num_steps, scene.model.nu))
    controls = np.asarray(recording.controls, float)
    if controls.ndim != 2 or controls.shape[1] != scene.model.nu:
        raise ValueError(f"controls of {name} must have {scene.model.nu} columns in this scene, got {controls.shape}")
    for text in clamped(scene, controls):
        warnings.warn(f"{scene.name}: in {name}, {text}", SceneWarning, stacklevel=4)
    if recording.control_times is not None:
        at = np.asarray(recording.control_times, float)
        _check_covered(recording, at, _times(recording, timestep)[-1], timestep)
        return _interpolated(timestep * np.arange(num_steps), at, controls)
    return np.pad(controls[:num_steps], ((0, max(0, num_steps - len(controls))), (0, 0)), mode="edge")


def _check_covered(recording: Recording, at: np.ndarray, end: float, timestep: float) -> None:
    """Refuse controls that are missing for more than one interval at the beginning or the end of a motion."""
    interval = float(np.median(np.diff(at))) if len(at) > 1 else timestep
    if max(at[0], end - at[-1]) > interval + _SAME * timestep:
        wanted, given = f"0 to {end:g} s but for one interval, {interval:.3g} s", f"{at[0]:g} to {at[-1]:g} s"
        raise ValueError(f"controls of {recording.name} must reach from {wanted}, got {given}")


def _interpolated(moments: np.ndarray, at: np.ndarray, controls: Any) -> np.ndarray:
    """Return the controls at other times, linear between their rows; the first and the last row are held."""
    rows = np.asarray(controls, float)
    columns = [np.interp(moments, at, column) for column in rows.reshape(len(at), rows[0].size).T]
    return np.reshape(columns, (len(columns), len(moments))).T
