"""Which identifies faster, `mg.identify` or `mujoco.sysid`, and do both give the same answer? `make identify-bench`.

`make identify-bench ARGS="--sets 20"` asks how often intervals hold on two robots with contact, see `robots`.

A chain of hinges is driven by motors. C MuJoCo simulates windows of 100 steps, each from another start, and the joint angles are
recorded with noise. Unknown are, joint by joint, the armature, the damping and the mass of the link. Both begin at the same wrong
values and minimise the same residuals in double precision. They take turns, so that load meets both alike.

- Theirs: one-sided differences of simulations by C MuJoCo, with as many threads as there are cores.
- Ours, search: on JAX's default device, without tracing and compiling; the first step, which holds them, counts as the others.
- Ours, called again: the whole call where the programs are in JAX's cache on disk. Every call traces anew.
- Ours, first call: with an empty cache.

Of what `mujoco[sysid]` brings, absl-py, colorama, pyyaml, scipy and tabulate are needed here.
"""

import contextlib
import gc
import io
import itertools
import logging
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cyclopts
import jax
import mujoco
import mujoco.rollout
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from mujoco import sysid

import mjxgrad as mg
from experiments.benchmarks import announce
from mjxgrad import identification

_FOLDER = Path(__file__).parent / "problems"
_NUM_STEPS = 100
_NOISE = 1e-3  # rad
_NOMINAL = {"armature": 0.02, "damping": 0.1, "mass": 0.5}  # kg m², N m s/rad, kg
_BOUNDS = (0.1, 10.0)  # of the nominal value, as ours has them by default
_LENGTH = 0.2  # of a link (m)
# The defaults of both, written out because they are printed, but for one. At their
# own xtol, 1e-8, rounding refuses the last step of the largest problem 140 times: 67 s in place of 23.
_THEIRS: dict[str, Any] = {"optimizer": "mujoco", "xtol": 1e-6, "gtol": 1e-8, "max_iters": 200}
_OURS: dict[str, Any] = {"max_steps": 100}
_HEAD = (
    "| parameters | windows | runs | theirs, s | steps | ours: search, s | steps | called again, s | first call, s "
    "| values differ, of intervals | relatively | intervals differ |\n" + "|---" * 12 + "|"
)


class Problem(NamedTuple):
    """What both are given: parameters as kind and joint, the chain with wrong values, and what was recorded."""

    unknown: list[tuple[str, int]]
    spec: Any
    starts: np.ndarray
    times: np.ndarray
    controls: np.ndarray
    measured: np.ndarray


class Answer(NamedTuple):
    """Values, half widths of their 95 % intervals, steps, seconds of the whole call, and of the search alone."""

    values: np.ndarray
    half_width: np.ndarray
    num_steps: int
    seconds: float
    searching: float


class Row(NamedTuple):
    """Seconds of each run, steps of theirs and ours, and largest differences: in half widths, relative, of half widths."""

    theirs: list[float]
    search: list[float]
    again: list[float]
    first: list[float]
    num_steps: tuple[int, int]
    apart: tuple[float, float, float]


def problem(num_parameters: int, num_windows: int) -> Problem:
    """Return a chain, and windows of its motion with numbers that are up to half smaller or larger."""
    kinds, random = list(_NOMINAL), np.random.default_rng(0)
    unknown = [(kinds[i % len(kinds)], i // len(kinds)) for i in range(num_parameters)]
    num_joints = unknown[-1][1] + 1
    spec = _chain(num_joints)
    truth = spec.copy()
    for kind, joint in unknown:
        _write(truth, kind, _element(kind, joint), _NOMINAL[kind] * random.uniform(0.5, 1.5))
    model, shape = truth.compile(), (num_windows, num_joints)
    moving = [0.5 * random.normal(size=shape), random.normal(size=shape)]  # rad, rad/s
    starts = np.concatenate([np.zeros((num_windows, 1)), *moving], axis=1)
    times = model.opt.timestep * np.arange(_NUM_STEPS + 1)
    rates, phases = random.uniform(3, 10, shape)[:, None], random.uniform(0, 2 * np.pi, shape)[:, None]
    controls = np.sin(rates * times[:, None] + phases)  # N m
    states = np.asarray(mujoco.rollout.rollout(model, mujoco.MjData(model), starts, controls[:, :-1])[0], float)
    angles = states[:, :, 1 : 1 + num_joints]
    return Problem(unknown, spec, starts, times, controls, angles + _NOISE * random.normal(size=angles.shape))


def _chain(num_joints: int) -> Any:
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.005
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    capsule = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": [0, 0, 0, _LENGTH, 0, 0], "size": [0.03, 0, 0]}
    body = spec.worldbody
    for i in range(num_joints):
        body = body.add_body(name=f"link{i}", pos=[_LENGTH * (i > 0), 0, 0])
        body.add_joint(name=f"joint{i}", axis=[0, 1 - i % 2, i % 2])
        body.add_geom(name=f"link{i}", **capsule)
        spec.add_actuator(name=f"motor{i}", target=f"joint{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        for kind, value in _NOMINAL.items():
            _write(spec, kind, _element(kind, i), value)
    return spec


def _element(kind: str, joint: int) -> str:
    """Name the element of the chain that has a kind of number."""
    return f"link{joint}" if kind == "mass" else f"joint{joint}"


# Where a specification has a number that is named as for `mg.identify`: kinds of elements, fields, entries of arrays, and signs.
_PLACES: dict[str, tuple[tuple[str, str, int | None, float], ...]] = {
    "mass": (("geom", "mass", None, 1.0),),
    "damping": (("joint", "damping", 0, 1.0),),
    "armature": (("joint", "armature", None, 1.0),),
    "friction_loss": (("joint", "frictionloss", None, 1.0),),
    "jnt_stiffness": (("joint", "stiffness", 0, 1.0),),
    "gear": (("actuator", "gear", 0, 1.0),),
    "gain": (("actuator", "gainprm", 0, 1.0), ("actuator", "biasprm", 1, -1.0)),
    "body_ipos": (("geom", "fromto", 0, 1.0), ("geom", "fromto", 3, 1.0)),  # of a capsule along another axis
    "body_pos": (("body", "pos", 2, 1.0),),
}


def _write(spec: Any, kind: str, name: str, value: float) -> None:
    """Write a number of an element into a specification; friction is that of all geoms."""
    if kind == "friction":
        for geom in spec.geoms:
            geom.friction[0] = value
        return
    for of, field, column, sign in _PLACES[kind]:
        element = getattr(spec, of)(name)
        if column is None:
            setattr(element, field, sign * value)
        else:
            getattr(element, field)[column] = sign * value


def _by_sysid(
    spec: Any, starts: Any, times: np.ndarray, controls: Any, measured: Any, unknown: dict[str, tuple]
) -> tuple[Any, np.ndarray, float]:
    """Return the record of `mujoco.sysid` of numbers (kind, element, nominal, bounds), half widths of intervals, and seconds."""
    model, parameters = spec.compile(), sysid.ParameterDict()
    names = [(f"{model.joint(i).name}_qpos", sysid.SignalType.MjStateQPos) for i in range(model.nv)]
    given = [sysid.TimeSeries(times, one) for one in controls]
    seen = [sysid.TimeSeries.from_names(times[1:], one, model, names) for one in measured]
    windows = [f"window{i}" for i in range(len(given))]
    sequences = sysid.ModelSequences("model", spec, windows, list(starts), given, seen, True)
    for label, (kind, name, *numbers) in unknown.items():

        def write(spec: Any, parameter: Any, kind: str = kind, name: str = name) -> None:
            _write(spec, kind, name, parameter.value[0])

        parameters.add(sysid.Parameter(label, *numbers, modifier=write))
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    begin = time.perf_counter()
    # The intervals need the last derivative, which is kept only where each step is printed.
    with contextlib.redirect_stdout(io.StringIO()):
        _, found = sysid.optimize(parameters, residual, verbose=False, **_THEIRS)
    left, _, _ = residual(found.x, parameters, return_pred_all=True)
    _, half_width = sysid.calculate_intervals(left, found.jac)
    return found, half_width, time.perf_counter() - begin


def solve_theirs(given: Problem) -> Answer:
    """Return the answer of `mujoco.sysid`."""
    unknown = {}
    for kind, joint in given.unknown:
        numbers = _NOMINAL[kind] * np.array([1.0, *_BOUNDS])
        unknown[f"{kind}{joint}"] = (kind, _element(kind, joint), *numbers.tolist())
    observed = given.starts, given.times, given.controls, given.measured
    found, half_width, seconds = _by_sysid(given.spec.copy(), *observed, unknown)
    return Answer(found.x, half_width, len(found.extras["objective"]) - 1, seconds, seconds)


def solve_ours(given: Problem) -> Answer:
    """Return the answer of `mg.identify`."""
    scene = mg.load_scene(given.spec.compile())
    unknown = {f"{kind}{i}": getattr(identification, kind)(scene, _element(kind, i)) for kind, i in given.unknown}
    recordings = []
    for start, controls, measured in zip(given.starts, given.controls, given.measured, strict=True):
        qpos, qvel = np.split(start[1:], 2)
        state = mg.initial_state(scene, qpos=qpos, qvel=qvel)
        noise = {"qpos": np.linalg.norm(measured, axis=0) / np.sqrt(2)}  # as theirs weighs each column
        one = identification.Recording({"qpos": measured}, controls[:-1], given.times[1:], noise=noise, start=state)
        recordings.append(one)
    moments = [time.perf_counter()]
    found = mg.identify(scene, unknown, recordings, log=lambda *_: moments.append(time.perf_counter()), **_OURS)
    if found.stopped is identification.Stopped.INTERRUPTED:
        raise KeyboardInterrupt
    moments.append(time.perf_counter())
    searching = (moments[-1] - moments[1]) * found.num_steps / max(found.num_steps - 1, 1)
    values, widths = (np.concatenate([np.ravel(x) for x in part.values()]) for part in (found.values, found.half_width))
    return Answer(values, widths, found.num_steps, moments[-1] - moments[0], searching)


def compare(given: Problem, runs: int, limit: float) -> Row:
    """Solve a problem in turns, ours once before; after `limit` seconds no turn but the first begins."""
    begin, first, theirs, ours = time.perf_counter(), solve_ours(given), [], []
    while not theirs or (len(theirs) < runs and time.perf_counter() - begin < limit):
        theirs.append(solve_theirs(given))
        ours.append(solve_ours(given))
    (expected, *_), (found, *_) = theirs, ours
    apart = (
        (found.values - expected.values) / expected.half_width,
        found.values / expected.values - 1,
        found.half_width / expected.half_width - 1,
    )
    search, again = [one.searching for one in ours], [one.seconds for one in ours]
    steps = (expected.num_steps, found.num_steps)
    difference, values, widths = (float(abs(x).max()) for x in apart)
    return Row([one.seconds for one in theirs], search, again, [first.seconds], steps, (difference, values, widths))


def _print(case: tuple[int, int], row: Row) -> None:
    theirs, search, again = (f"{statistics.median(x):.3g} ({min(x):.3g})" for x in (row.theirs, row.search, row.again))
    times = (theirs, row.num_steps[0], search, row.num_steps[1], again, f"{row.first[0]:.3g}")
    cells = (*case, len(row.theirs), *times, *(f"{x:.0e}" for x in row.apart))
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


class Robot(NamedTuple):
    """A robot's file, the place at which its joints start, its controls, and ten numbers by the arguments of `identification`."""

    file: Path
    start: tuple[float, ...]
    drive: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    num_steps: int
    numbers: dict[str, tuple[Any, ...]]

    def place(self, number: str) -> tuple[str, str]:
        """Return the kind of a number, as `_write` has it, and the name of its element."""
        kind, *names = (one for one in self.numbers[number] if isinstance(one, str) and one != "number")
        return kind, next(iter(names), "")


def _sled_drive(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    (fast, slow, swing), phase = 2 * np.pi * rng.uniform(1, 3, 3), rng.uniform(0, 2 * np.pi, 2)
    push = 0.8 * np.sin(fast * times + phase[0]) + 0.2 * np.sin(2 * slow * times)
    return np.stack([push, 0.6 * np.sin(swing * times + phase[1])], axis=1)


def _leg_drive(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    rate, phase, size = 2 * np.pi * rng.uniform(1.5, 3, 2), rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.25, 0.4, 2)
    return (0.45, -0.9) + size * (1, 1.5) * (np.sin(rate * times[:, None] + phase) - np.sin(phase))


_KP = lambda model, value: {  # noqa: E731
    "actuator_gainprm": model.actuator_gainprm.at[0, 0].set(value),
    "actuator_biasprm": model.actuator_biasprm.at[0, 1].set(-value),
}
ROBOTS = {
    "sled": Robot(
        _FOLDER / "sled.xml",
        (0.0, 0.0, 0.0),
        _sled_drive,
        300,
        {
            "friction": ("friction",),
            "mass": ("mass", "sled"),
            "damping": ("damping", "hinge"),
            "armature": ("armature", "hinge"),
            "gear": ("gear", "push"),
            "gear of swing": ("gear", "swing"),
            "friction loss": ("friction_loss", "hinge"),
            "damping of x": ("damping", "x"),
            "spring": ("number", "jnt_stiffness", "hinge"),
            "place of the centre": ("number", "body_ipos", "pole", 0, (-0.05, 0.05)),
        },
    ),
    "leg": Robot(
        _FOLDER / "leg.xml",
        (0.0, 0.0, 0.45, -0.9),
        _leg_drive,
        400,
        {
            "friction": ("friction",),
            "mass of the hip": ("mass", "hip"),
            "mass of the thigh": ("mass", "thigh"),
            "armature of the thigh": ("armature", "thigh"),
            "damping": ("damping", "knee"),
            "armature": ("armature", "knee"),
            "gain": ("gain", "thigh"),
            "friction loss": ("friction_loss", "knee"),
            "friction loss of the thigh": ("friction_loss", "thigh"),
            "length": ("number", "body_pos", "shank", 2, (-0.3, -0.1)),
        },
    ),
}


class Set(NamedTuple):
    """A scene with nominal numbers, ten parameters, their true values, and five recordings."""

    scene: mg.Scene
    parameters: dict[str, identification.Parameter]
    truth: dict[str, float]
    recordings: list[identification.Recording]


def recorded(robot: Robot, seed: int, count: int = 5) -> Set:
    """Return recordings of a robot whose numbers are 30 % off, give or take: joints to 1 mm and 1 mrad, the first row, too."""
    scene, rng = mg.load_scene(robot.file, keep_everything=True), np.random.default_rng(seed)
    parameters, truth = {}, {}
    for name, (kind, *arguments) in robot.numbers.items():
        if kind == "gain":
            made = identification.Parameter(60.0, 6.0, 600.0, _KP)
        else:
            names = [one for one in arguments if isinstance(one, str)]
            given = dict(zip(("column", "bounds"), arguments[len(names) :], strict=False))
            made = getattr(identification, kind)(scene, *names, **given)
        parameters[name] = made
        off = rng.uniform(-0.3, 0.3)
        truth[name] = float(made.nominal) * np.exp(off) if made.nominal else off * float(made.upper)
    spec = mujoco.MjSpec.from_file(str(robot.file))
    for name, value in truth.items():
        _write(spec, *robot.place(name), value)
    model, recordings = spec.compile(), []
    for _ in range(count):
        data, controls = mujoco.MjData(model), robot.drive(rng, model.opt.timestep * np.arange(robot.num_steps))
        data.qpos[:] = robot.start
        places = [data.qpos.copy()]
        for ctrl in controls:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
            places.append(data.qpos.copy())
        measured = np.array(places) + _NOISE * rng.normal(size=(len(places), model.nq))
        recordings.append(identification.Recording({"qpos": measured}, controls, noise={"qpos": _NOISE}))
    return Set(scene, parameters, truth, recordings)


class Verdict(NamedTuple):
    """Errors in half widths of the 95 % intervals, half widths over the values, and seconds."""

    errors: np.ndarray
    widths: np.ndarray
    seconds: float


def judge(given: Set) -> Verdict:
    """Return the verdict on `mg.identify`."""
    begin = time.perf_counter()
    found = mg.identify(given.scene, given.parameters, given.recordings)
    seconds = time.perf_counter() - begin
    truth = np.array(list(given.truth.values()))
    values, halves = (
        np.array([float(part[name]) for name in given.truth]) for part in (found.values, found.half_width)
    )
    return Verdict((values - truth) / halves, halves / np.abs(truth), seconds)


def judge_theirs(robot: Robot, given: Set) -> Verdict:
    """Return the verdict on `mujoco.sysid`, whose starts are the first rows, at rest."""
    spec = mujoco.MjSpec.from_file(str(robot.file))
    times = spec.option.timestep * np.arange(robot.num_steps + 1)
    starts = [np.pad(one.measured["qpos"][0], (1, len(robot.start))) for one in given.recordings]
    controls = [np.vstack([one.controls, one.controls[-1:]]) for one in given.recordings]
    measured = [one.measured["qpos"][1:] for one in given.recordings]
    unknown = {
        name: (*robot.place(name), *map(float, (one.nominal, one.lower, one.upper)))
        for name, one in given.parameters.items()
    }
    found, half, seconds = _by_sysid(spec, starts, times, controls, measured, unknown)
    truth = np.array(list(given.truth.values()))
    return Verdict((found.x - truth) / half, half / np.abs(truth), seconds)


def robots(sets: int, limit: float) -> None:
    """Measure how often intervals of ten numbers hold: so many sets of five recordings of each robot.

    Args:
        sets: sets of recordings of a robot.
        limit: of theirs on a robot, after which no other run begins (s).
    """
    for name, robot in ROBOTS.items():
        ours, theirs, spent = [], [], 0.0
        for seed in range(sets):
            given = recorded(robot, seed)
            ours.append(judge(given))
            if spent < limit:
                theirs.append(judge_theirs(robot, given))
                spent += theirs[-1].seconds
            print(
                f"  {name} {seed}: {ours[-1].seconds:.1f} s, {np.sum(abs(ours[-1].errors) <= 1)} of 10 hold", flush=True
            )
        for who, found in (("mg.identify", ours), ("mujoco.sysid", theirs)):
            errors, widths = np.array([one.errors for one in found]), np.median([one.widths for one in found], axis=0)
            held, seconds = np.abs(errors) <= 1, [one.seconds for one in found]
            print(
                f"| {name} | {who} | {len(found)} | {100 * held.mean():.0f} % | "
                f"{statistics.median(seconds):.1f} ({min(seconds):.1f} to {max(seconds):.1f}) | "
                + ", ".join(
                    f"{key} {n} ({100 * w:.2g} %)"
                    for key, n, w in zip(robot.numbers, held.sum(axis=0), widths, strict=True)
                )
                + " |",
                flush=True,
            )


_Many = cyclopts.Parameter(consume_multiple=True, negative="")


def identify(
    *,
    parameters: Annotated[tuple[int, ...], _Many] = (1, 8, 30),
    windows: Annotated[tuple[int, ...], _Many] = (1, 10, 100),
    runs: int = 5,
    limit: float = 120,
    sets: int = 0,
) -> None:
    """Measure identification against mujoco.sysid.

    Args:
        parameters: how many are unknown, case by case.
        windows: how many are recorded, case by case.
        runs: runs of a problem.
        limit: of a problem, after which no other run begins (s).
        sets: where above 0, sets of five recordings of each of two robots, in place of the chains.
    """
    logging.getLogger("absl").setLevel(logging.ERROR)  # theirs warns of each window that angles are no sensors
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    announce(f"load {os.getloadavg()[0]:.1f} before")
    if sets:
        print(
            "| robot | by | sets | intervals that hold | seconds | of these (median half width) |\n" + "|---" * 6 + "|"
        )
        return robots(sets, limit)
    print(
        f"theirs: {_THEIRS}\nours: {_OURS}, ends when 1e-3 of a standard error is left to go\n"
        f"seconds are the median of the runs (and the least), differences the largest\n\n{_HEAD}"
    )
    for case in itertools.product(parameters, windows):
        # Nothing of one problem helps the next to compile, or is searched for garbage while theirs runs.
        jax.clear_caches()
        gc.collect()
        with tempfile.TemporaryDirectory() as empty:
            jax.config.update("jax_compilation_cache_dir", empty)
            compilation_cache.reset_cache()
            row = compare(problem(*case), runs, limit)
        _print(case, row)
