"""Recordings and parameters from files, and identified scenes as MJCF."""

import csv
import dataclasses
import difflib
import os
import re
import warnings
import zipfile
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from mjxgrad._arrays import real
from mjxgrad._text import write
from mjxgrad.identification import parameters
from mjxgrad.identification.parameters import Parameter
from mjxgrad.identification.recording import Recording, coordinates
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.scene.scene import numbers_of

_SOFTNESS = ("stiffness", "damping_ratio", "width")
_NAMED = ("mass", "damping", "armature", "friction_loss", "gear", "gains")
KINDS = ("mass", "inertia", "friction", *_SOFTNESS, *_NAMED[1:], "delay")
"""Kinds of parameters that `parameter` knows."""
_Sizes = Mapping[str, float]  # of noise
_LIKE = 0.75  # similarity from which an unknown column is perhaps one of the scene's
_SMALLEST_SIZE = 0.1  # share of the largest column of a kind, the least scale of any column: smaller motion is noise


def parameter(scene: Scene, text: str) -> Parameter:
    """Return a parameter from text such as `mass:torso`, `friction`, `damping:hip,knee=0.1..5` or `delay=0..0.05`.

    The text is one of `KINDS` or a field of the model, then names that share one value, then bounds. Friction and softness take
    geoms, or a pair as `floor/foot`, or nothing for all contacts; a field with several numbers a column, `body_pos[2]:shin`.
    The scene has the nominal values.

    Raises:
        ValueError: if the text has another form, or a name is unknown.
    """
    match = re.fullmatch(r"(\w+(?:\[\d+\])?)(?::([^=]+))?(?:=([^=]+?)\.\.([^=]+))?", text)
    field, _, column = (match[1] if match else "").rstrip("]").partition("[")
    is_field = field not in KINDS and field in numbers_of(scene.model)
    if match is None or not (match[1] in KINDS or is_field):
        near = difflib.get_close_matches(field, [*KINDS, *numbers_of(scene.model)], 1)
        more = f"; did you mean {near[0]}?" if near else ", or a field of the model such as body_pos[2]"
        raise ValueError(f"a parameter must be kind:name=low..high, kind one of {', '.join(KINDS)}; got {text!r}{more}")
    kind, names = match[1], tuple((match[2] or "").split(",")) if match[2] else ()
    try:
        bounds = None if match[3] is None else (float(match[3]), float(match[4]))
    except ValueError as error:
        raise ValueError(f"bounds must be numbers, low..high, got {text!r}") from error
    if kind == "delay":
        low, high = bounds or (0.0, 0.05)
        if names or low < 0:
            raise ValueError(f"delay must be of all controls and at least 0 s, delay or delay=low..high, got {text!r}")
        return Parameter(low, low, high, unit="s")
    if kind == "friction" or kind in _SOFTNESS:
        given = {} if bounds is None else {"bounds": bounds}
        if kind == "friction":
            return parameters.friction(scene, *names, **given)
        return parameters.softness(scene, kind, *names, **given)
    if not names:
        raise ValueError(f"{kind} must say of what, {kind}:name, got {text!r}")
    if is_field:
        if (shape := numbers_of(scene.model)[field].shape)[1:] and not column:
            columns = f"a column from 0 to {shape[1] - 1}, such as {field}[{shape[1] - 1}]:{match[2]}"
            raise ValueError(f"{field} must have {columns}; got {text!r}")
        return parameters.number(scene, field, *names, column=int(column) if column else None, bounds=bounds)
    if kind in _NAMED:
        return getattr(parameters, kind)(scene, *names, bounds=bounds)
    if len(names) > 1 or bounds is not None:
        raise ValueError(f"inertia takes one name, and no bounds, got {text!r}")
    return parameters.inertia(scene, *names)


def recording(scene: Scene, path: str | Path, noise: _Sizes | None = None) -> tuple[Recording, tuple[str, ...]]:
    """Return a motion recorded as CSV with a line of names, or as NPZ, and the names of columns that the scene does not have.

    Columns are as `mjxgrad identify --help` tells. An array of an NPZ has one row per time, with one number or all of the
    element's numbers. The motion begins at its first row; missing parts are the scene's pose, at rest.

    Args:
        scene: from `load_scene`.
        path: the file.
        noise: standard deviations of all that was measured, by column or by signal, such as qvel. Without them each signal
            is weighed by its variation.

    Raises:
        ValueError: if the file has another form, no time, no measurement, or lacks the control of an actuator; if the noise
            is not positive, or not that of all measured columns.
    """
    places, unknown = _places(scene.mj_model), []
    columns = _read(Path(path), {"time", *places})
    times = columns.pop("time", None)
    if times is None:
        raise ValueError(f"{path} must have a column named time (s), got {', '.join(columns) or 'nothing'}")
    if len(times) < 2:
        raise ValueError(f"{path} must have at least two rows of numbers, got {len(times)}")
    if late := np.flatnonzero(~(np.diff(times) > 0)).tolist():
        raise ValueError(f"time in {path} must increase, got {times[late[0]]:g}, then {times[late[0] + 1]:g}")
    found: dict[str, np.ndarray] = {}
    told: set[tuple[str, int]] = set()  # signals and indices that have a column
    for name, column in columns.items():
        place = places.get(name, ())
        if len(place) > 1:
            kinds = ", ".join(sorted(f"{kind}:{name}" for kind, *_ in place))
            raise ValueError(f"{name} of {path} must say what it is, as one of {kinds}")
        if not place and name.partition(":")[0] in ("qpos", "qvel", "ctrl", "act", "sensor"):
            near = "".join(f"; did you mean {one}?" for one in difflib.get_close_matches(name, places, 1))
            raise ValueError(f"{path} has a column {name}, which is not of this scene{near}")
        if not place:
            unknown.append(name)
            continue
        _, signal, index, width = place[0]
        found.setdefault(signal, np.full((len(times), width), np.nan))[:, index] = column
        told.add((signal, index))
    controls = found.pop("ctrl", np.full((len(times), scene.model.nu), np.nan))
    if faults := list(_faults(scene, controls, times, told, unknown)):
        raise ValueError(f"{path} must have the control of every actuator in every row, ctrl:name; {'; '.join(faults)}")
    if not found:
        near = [m for name in unknown for m in difflib.get_close_matches(name, places, 1)]
        given = (", ".join(unknown) or "none") + f"; did you mean {', '.join(near)}?" * bool(near)
        raise ValueError(f"{path} must have columns of the scene's joints or sensors, got {given}")
    scale = {name: _size(scene.mj_model, name, value) for name, value in found.items()}
    if noise:
        scale = _stated(scene, found, noise, str(path))
    for name in unknown:
        free = [one for one, place in places.items() if place[0][1:3] not in told]
        for near in difflib.get_close_matches(name, free, 1, _LIKE):
            text = f"{path} has a column {name}, which is not of this scene and is left out; did you mean {near}?"
            warnings.warn(text, SceneWarning, stacklevel=2)
    at = times - times[0]
    driven = {"controls": controls, "control_times": at} if scene.model.nu else {}
    return Recording(found, times=at, noise=scale, knows_noise=bool(noise), name=str(path), **driven), tuple(unknown)


def _faults(
    scene: Scene, controls: np.ndarray, times: np.ndarray, told: Container[tuple[str, int]], unknown: Sequence[str]
) -> Iterator[str]:
    """Yield what controls lack: columns, with what they are perhaps called instead, or numbers in them."""
    names, missing = column_names(scene), ~np.isfinite(controls)
    for i in np.flatnonzero(missing.any(axis=0)).tolist():
        name, row = names["ctrl", i].removeprefix("ctrl:"), int(missing[:, i].argmax())
        if ("ctrl", i) in told:
            yield f"its column {name} has no finite number in row {row + 1}, at {times[row]:g} s"
        else:
            yield f"it lacks {name}" + "".join(
                f" (is it {one}?)" for one in difflib.get_close_matches(name, unknown, 1)
            )


def _read(path: Path, known: Container[str]) -> dict[str, np.ndarray]:
    """Return the columns of a file by name; those that are not known may be of text, and are of NaN."""
    is_npz = path.suffix == ".npz"
    try:
        found = (_read_npz if is_npz else _read_csv)(path, known)
    except (ValueError, TypeError, AttributeError, EOFError, csv.Error, zipfile.BadZipFile) as error:
        form = (
            "an NPZ with arrays of numbers"
            if is_npz
            else "a line of names, then numbers with decimal points, separated by commas"
        )
        raise ValueError(f"{path} must be {form}: {error}") from error
    if len({len(column) for column in found.values()}) > 1:
        raise ValueError(f"columns of {path} must be as long as time, got { ({n: len(c) for n, c in found.items()}) }")
    return found


def _read_npz(path: Path, known: Container[str]) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no archive of arrays")
    with np.load(path) as arrays:
        wholes = {name: arrays[name] for name in arrays}
    for name, value in wholes.items():
        is_text = value.dtype.kind in "US" and name not in known
        wholes[name] = np.full(value.shape, np.nan) if is_text else np.asarray(real(name, value), float)
    wholes = {name: value.reshape(len(value), -1) for name, value in wholes.items() if value.ndim}
    return {f"{n}[{i}]" if v.shape[1] > 1 else n: v[:, i] for n, v in wholes.items() for i in range(v.shape[1])}


def _read_csv(path: Path, known: Container[str]) -> dict[str, np.ndarray]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file)
        (first, names), *rows = [(reader.line_num, row) for row in reader if row] or [(1, [""])]
    names = [name.strip() for name in names]
    if names[0].startswith("#"):
        raise ValueError(f"line {first} is a comment, not names")
    if len(names) == 1 and (marks := [mark for mark in ";\t" if mark in names[0]]):
        raise ValueError(f"its cells are separated by {marks[0]!r}")
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise ValueError(f"{', '.join(twice)} stands there more than once")
    numbers = []
    for line, row in rows:
        if len(row) != len(names):
            raise ValueError(f"line {line} has {len(row)} cells, not {len(names)}")
        cells = zip(names, row, strict=True)
        numbers.append([_number(name, cell, line) if name in known else np.nan for name, cell in cells])
    return dict(zip(names, np.reshape(numbers, (len(rows), len(names))).T, strict=True))


def _number(name: str, cell: str, line: int) -> float:
    try:
        return float(cell) if cell.strip() else np.nan
    except ValueError:
        raise ValueError(f"{name} in line {line} is no number: {cell!r}") from None


def _places(model: mujoco.MjModel) -> dict[str, list[tuple[str, str, int, int]]]:
    """Return for each possible column name its kind, signal, index in the signal, and the signal's width."""
    whole: dict[str, list] = {}
    own: list[tuple[str, str, Sequence[int] | np.ndarray, int]] = []
    for i, first, end in zip(range(model.njnt), model.jnt_qposadr, [*model.jnt_qposadr[1:], model.nq], strict=True):
        name = model.joint(i).name
        own.append(("qpos", name, range(first, end), model.nq))
        own.append(("qvel", name, np.flatnonzero(model.dof_jntid == i), model.nv))
    for i in range(model.nactuator):
        name = model.actuator(i).name
        for kind, first, count, width in (  # of controls a pid has several
            ("ctrl", model.actuator_ctrladr[i], model.actuator_ctrlnum[i], model.nu),
            ("act", model.actuator_actadr[i], model.actuator_actnum[i], model.na),
        ):
            own.append((kind, name, range(first, first + count), width))
    own += [("sensor", model.sensor(i).name, range(n), int(n)) for i, n in enumerate(model.sensor_dim)]
    for kind, name, indices, width in own:
        for i, index in enumerate(indices):
            signal, number = name if kind == "sensor" else kind, f"[{i}]" * (len(indices) > 1)
            place = (kind, signal, int(index), width)
            if kind != "sensor":
                # A joint and an index may name the same place; for one number `qpos` is the whole.
                whole[f"{kind}[{index}]" if width > 1 else kind] = [place]
            if name:
                whole[f"{kind}:{name}{number}"] = [place]
                if kind in ("qpos", "ctrl", "sensor"):
                    whole.setdefault(f"{name}{number}", []).append(place)
    return whole


def column_names(scene: Scene) -> dict[tuple[str, int], str]:
    """Return the column name for each number of a signal, by signal and index."""
    places = sorted(_places(scene.mj_model).items(), key=lambda item: ":" in item[0])
    return {(signal, index): name for name, [(_, signal, index, _), *_] in places}


def _size(model: mujoco.MjModel, name: str, value: np.ndarray) -> np.ndarray:
    """Return the variation of each column; for positions, one number per velocity."""
    if name == "qpos":
        first = np.where(np.isfinite(value[0]), value[0], model.qpos0)
        moves = np.zeros((len(value), model.nv))
        for move, row in zip(moves, np.where(np.isfinite(value), value, first), strict=True):
            mujoco.mj_differentiatePos(model, move, 1.0, first, row)
        value = moves
    size = np.ma.masked_invalid(value).std(axis=0).filled(0.0)
    return np.maximum(size, _SMALLEST_SIZE * size.max(initial=0.0)) if size.any() else np.ones_like(size)


def _stated(scene: Scene, found: Mapping[str, np.ndarray], noise: _Sizes, path: str) -> dict[str, np.ndarray]:
    """Return the stated noise of each column; for positions, one number per velocity."""
    model, places = scene.mj_model, _places(scene.mj_model)
    scale = {name: np.full(value.shape[1], np.nan) for name, value in found.items()}
    for name, size in noise.items():
        if not 0 < size < np.inf:
            raise ValueError(f"noise of {name} must be positive and finite, got {size}")
        place = places.get(name, ())
        signal, index = (name, slice(None)) if name in found else place[0][1:3] if len(place) == 1 else ("", 0)
        if signal not in found:
            raise ValueError(f"noise must name columns of {path}, or {', '.join(found)}; got {name}")
        scale[signal][index] = size
    for (signal, index), name in column_names(scene).items():
        if signal in found and np.isfinite(found[signal][:, index]).any() and np.isnan(scale[signal][index]):
            raise ValueError(f"noise must be stated of every measured column or of none, it lacks {name}")
    if "qpos" in scale:
        scale["qpos"] = np.array([np.nanmax(scale["qpos"][one], initial=0.0) for one in coordinates(model)])
    return {name: np.where(size > 0, size, 1.0) for name, size in scale.items()}


def hold_out(recordings: Sequence[Recording], share: float) -> tuple[list[Recording], list[Recording]]:
    """Split recordings into those to fit and a held-out share: every n-th of several, or the end of a single one.

    Raises:
        ValueError: if the share is negative or leaves nothing to fit.
    """
    if not 0 <= share < 1:
        raise ValueError(f"held_out must be a share from 0 to below 1, got {share}")
    if share == 0:
        return list(recordings), []
    if len(recordings) > 1:
        every = min(max(2, round(1 / share)), len(recordings))
        return [one for i, one in enumerate(recordings, 1) if i % every], list(recordings[every - 1 :: every])
    (whole,) = recordings
    times = np.asarray(whole.times, float)
    is_late = times > (1 - share) * times[-1]
    early = {name: value[~is_late] for name, value in whole.measured.items()}
    # The end starts where the recording does: positions and speeds in the middle may be unmeasured.
    is_kept = is_late | (times == times[0])
    late = {name: np.where(is_kept[:, None], value, np.nan) for name, value in whole.measured.items()}
    fitted = dataclasses.replace(whole, measured=early, times=times[~is_late])
    return [fitted], [dataclasses.replace(whole, measured=late)]


def write_xml(scene: Scene, found: Scene, source: str | Path, path: str | Path) -> None:
    """Write the MJCF file of a scene with the numbers that were found; all else stays as in the source."""
    spec = mujoco.MjSpec.from_file(str(source))
    model = spec.compile()
    before, after = numbers_of(scene.model), numbers_of(found.model)
    for field in before:
        place = getattr(model, field, None)
        if isinstance(place, np.ndarray) and place.size == before[field].size:
            old, new = (np.asarray(x[field], float).reshape(place.shape) for x in (before, after))
            place[:] = np.where(old != new, new, place)
    spec.copy_back(model)
    for folder in ("meshdir", "texturedir"):
        there = Path(source).parent / (getattr(spec, folder) or "")
        setattr(spec, folder, os.path.relpath(there, Path(path).parent))
    write(path, spec.to_xml())
