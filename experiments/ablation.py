"""What is left out of a step, put back piece by piece: what that costs in time, memory and compilation, by both engines."""

import dataclasses
import functools
import time
import tracemalloc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from pydantic import Field

from experiments.parallel import num_compilers
from experiments.problems.left_out import ONLY_GRADIENT, PARTS, PartName, SceneName, file_of, is_left_out, program
from experiments.report import Table
from experiments.settings import RunSettings, SettingsTable
from experiments.theme import FIRST, MUTED, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.words import joined, quantity
from experiments.workspace import Workspace
from mjxgrad.stepping import EngineName

_Count = Annotated[int, Field(ge=2)]
_ROUNDING = 100.0  # times what four roundings of the start make of a result: within that two programs give the same
_LEAST = 1.1  # a factor that counts
_TITLES: dict[EngineName, str] = {"mjx": "MJX", "mujoco": "C MuJoCo"}


class Sizes(SettingsTable):
    """How much is measured."""

    scenes: dict[SceneName, tuple[PartName, ...]]
    """What MJX is given back in each scene; C MuJoCo, whose programs are small, is given back all that it leaves out."""
    batch: _Count
    """Rollouts that MJX steps together."""
    few: _Count
    """Rollouts that C MuJoCo steps together."""
    horizon: _Count
    """Time steps of a rollout."""
    repeats: _Count
    """Turns, in each of which every program runs once."""


class Settings(RunSettings):
    """Time, memory and results of scenes with parts put back."""

    size: Literal["quick", "default", "full"] = "default"
    """How much is measured."""
    sizes: Sizes
    """The numbers that go with the size: those of the file's table of that name."""


@dataclass(frozen=True)
class Cost:
    """What a part costs that is put back into one program, over what that takes without it.

    Attributes:
        time: quartiles and median over turns.
        seconds, num_bytes, compile_seconds: without the part.
        difference: largest change of a result, over the largest result.
        rounding: the same of a start that is moved by four roundings.
    """

    scene: str
    engine: EngineName
    part: str
    work: str
    time: tuple[float, float, float]
    memory: float
    compilation: float
    seconds: float
    num_bytes: float
    compile_seconds: float
    difference: float
    rounding: float

    @property
    def is_same(self) -> bool:
        return self.difference <= _ROUNDING * max(self.rounding, np.finfo(float).eps)


@dataclass(frozen=True)
class Outcome:
    """All costs."""

    settings: Settings
    costs: list[Cost]

    def rows(self) -> list[dict[str, Any]]:
        """One row per cost, for metrics.csv."""
        return [dataclasses.asdict(cost) for cost in self.costs]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure scene by scene."""
    costs, had_cache = [], jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)  # compilation is measured, too
    try:
        with workspace.stage("scenes", "scenes", len(settings.sizes.scenes)) as advance_to:
            for k, name in enumerate(settings.sizes.scenes, start=1):
                costs += workspace.once(name, functools.partial(of_scene, name, settings))
                advance_to(k)
    finally:
        jax.config.update("jax_enable_compilation_cache", had_cache)
    return Outcome(settings, costs)


def of_scene(name: SceneName, settings: Settings) -> list[Cost]:
    """Measure one scene by both engines."""
    sizes, costs = settings.sizes, []
    by: dict[EngineName, tuple] = {"mjx": (sizes.scenes[name], sizes.batch), "mujoco": (PARTS, sizes.few)}
    for engine, (chosen, count) in by.items():
        keys = [key for key in chosen if is_left_out(key, name, engine)]
        # Room is what `load_scene` keeps, unless it is told otherwise.
        variants = {"": []} | {k: [PARTS[k]] for k in keys} | {"all": [PARTS[k] for k in keys if k != "room"]}
        variants |= {"mjx.step": [PARTS["mjx.step"]]} if engine == "mjx" else {}
        starts = _starts(file_of(name).compile(), count, sizes.horizon, settings.seed)
        for work in ("forward", "gradient"):
            own = {k: v for k, v in variants.items() if work == "gradient" or k not in ONLY_GRADIENT}
            costs += _compare(name, engine, work, own, starts, sizes.repeats)
    return costs


def _starts(model: mujoco.MjModel, count: int, horizon: int, seed: int) -> tuple[jax.Array, ...]:
    """Return states that have fallen for a while and are stirred a little, and controls within half of their range."""
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    mujoco.mj_step(model, data, round(0.3 / model.opt.timestep))
    low, high = np.where(model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange.T, [[-1.0], [1.0]])
    ctrl = (low + high) / 2 + 0.25 * (high - low) * random.uniform(-1, 1, (count, horizon, model.nu))
    qvel = data.qvel + 0.2 * random.normal(size=(count, model.nv))
    return jnp.asarray(np.tile(data.qpos, (count, 1))), jnp.asarray(qvel), jnp.asarray(ctrl)


def _compare(name: str, engine: EngineName, work: str, variants: dict, starts: tuple, repeats: int) -> list[Cost]:
    """Let programs take turns, and compare what they take and give with the first one, which leaves all out."""
    with ThreadPoolExecutor(num_compilers()) as pool:
        traced = {key: program(name, parts, engine, work, starts) for key, parts in variants.items()}
        made = {key: pool.submit(one.compiled) for key, one in traced.items() if one is not None}
    made = {key: future.result() for key, future in made.items()}
    results = {key: _numbers(run(*starts)) for key, (run, *_) in made.items()}
    turns = [{key: _seconds(run, starts) for key, (run, *_) in made.items()} for _ in range(repeats)]
    memory = {key: size + (_peak(run, starts) if engine == "mujoco" else 0) for key, (run, _, size) in made.items()}
    signs = [np.random.default_rng(k).choice([-1.0, 1.0], x.shape) for k, x in enumerate(starts)]
    moved = (x * (1 + 4 * np.finfo(float).eps * sign) for x, sign in zip(starts, signs, strict=True))
    scale, rounded = np.abs(results[""]).max(), _numbers(made[""][0](*moved))
    off = {key: float(np.abs(found - results[""]).max() / scale) for key, found in (results | {"": rounded}).items()}
    costs = []
    for key in list(made)[1:]:
        more, less = ("", key) if key == "room" else (key, "")
        low, middle, high = np.quantile([turn[more] / turn[less] for turn in turns], [0.25, 0.5, 0.75]).tolist()
        ratios = (low, middle, high), memory[more] / memory[less], made[more][1] / made[less][1]
        seconds = float(np.median([turn[less] for turn in turns]))
        costs.append(Cost(name, engine, key, work, *ratios, seconds, memory[less], made[less][1], off[key], off[""]))
    return costs


def _numbers(result: Any) -> np.ndarray:
    """Return the ends or the gradients of a program, without its record."""
    return np.concatenate([np.asarray(leaf, float).ravel() for leaf in jax.tree.leaves(result[0])])


def _seconds(run: Callable, starts: tuple) -> float:
    began = time.perf_counter()
    run(*starts)
    return time.perf_counter() - began


def _peak(run: Callable, starts: tuple) -> float:
    """Return the most bytes that arrays of numpy hold while a program runs."""
    tracemalloc.start()
    run(*starts)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def answer(outcome: Outcome) -> str:
    """Say which part buys most memory, and which most time."""
    told = []
    for word, factor in (("memory", lambda cost: cost.memory), ("time", lambda cost: cost.time[1])):
        best = max(_single(outcome), key=factor)
        told.append(f"{PARTS[best.part].what}: {_times(factor(best))} {word} ({best.scene}, {_TITLES[best.engine]})")
    return "; ".join(told) + "."


def verdict(outcome: Outcome) -> str:
    """Say what all parts cost together, and which cost nothing."""
    told = []
    for engine, title in _TITLES.items():
        spans = []
        for work in ("forward", "gradient"):
            factors = [c.time[1] for c in outcome.costs if (c.part, c.engine, c.work) == ("all", engine, work)]
            spans += [f"{work} {_times(min(factors))} to {_times(max(factors))}"] if factors else []
        told.append(f"{title}: {', '.join(spans)}")
    single = _single(outcome)
    found = [key for key in PARTS if any(c.part == key for c in single)]
    idle = [k for k in found if all(c.time[0] < _LEAST and c.memory < _LEAST for c in single if c.part == k)]
    helps = [f"{PARTS[c.part].what} on {c.scene}" for c in single if c.time[2] < 1 / _LEAST]
    listed = joined([PARTS[key].what for key in idle] or ["nothing"])
    return (
        f"Time with all of it put back, by scene: {'; '.join(told)}. {listed.capitalize()} costs nothing anywhere. "
        f"Faster with than without: {joined(dict.fromkeys(helps)) if helps else 'nothing'}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say where results differ beyond rounding, and what has no gradient."""
    told = []
    for key in dict.fromkeys(c.part for c in outcome.costs if not c.is_same):
        costs = [c for c in outcome.costs if c.part == key and not c.is_same]
        why, worst = PARTS[key].off or "those of its parts", max(costs, key=lambda c: c.difference)
        where = joined(dict.fromkeys(c.scene for c in costs))
        told.append(
            f"{PARTS[key].what}: results differ on {where} by up to {quantity(worst.difference)} of the largest ({why})."
        )
    told.append("All other results are the same to rounding. mjx.step has no gradient in reverse mode.")
    return told


def _single(outcome: Outcome) -> list[Cost]:
    return [cost for cost in outcome.costs if cost.part not in ("all", "mjx.step")]


def _times(factor: float) -> str:
    return f"{factor:.3g}×"


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate each engine's factors."""
    found, sizes = [], outcome.settings.sizes
    for engine, title in _TITLES.items():
        rows, emphasised, costs = [], set(), {(c.scene, c.part, c.work): c for c in outcome.costs if c.engine == engine}
        for scene, key in dict.fromkeys((c.scene, c.part) for c in costs.values()):
            row = [scene, PARTS[key].what, PARTS[key].why]
            for work in ("forward", "gradient"):
                cost = costs.get((scene, key, work))
                emphasised |= {(len(rows), len(row))} if cost and cost.time[0] > _LEAST else set()
                row += _cells(cost) if cost else [""] * 4
            rows.append(row)
        parts = ("time", "memory", "compilation", "difference")
        columns = (
            "scene",
            f"back into {title}",
            "why not",
            *(f"{work}, {x}" for work in ("motion", "gradient") for x in parts),
        )
        caption = (
            "Factors over the program without, which the row of all of these tells: time with quartiles over turns, bold where "
            "these are above 1.1, memory beside arguments, compilation of two programs at a time. Differences over the largest "
            f"result; * beyond rounding. {sizes.horizon} steps of {sizes.batch if engine == 'mjx' else sizes.few} rollouts."
        )
        found.append(Table(columns, rows, caption, frozenset(emphasised)))
    return found


def _cells(cost: Cost) -> list[str]:
    low, middle, high = (f"{x:.3g}" for x in cost.time)
    without = (
        f" × {1e3 * cost.seconds:.3g} ms",
        f" × {cost.num_bytes / 1e3:.3g} kB",
        f" × {cost.compile_seconds:.2g} s",
    )
    ratios = (f"{middle} ({low} to {high})", f"{cost.memory:.3g}", f"{cost.compilation:.2g}")
    cells = [ratio + base * (cost.part == "all") for ratio, base in zip(ratios, without, strict=True)]
    return [*cells, f"{cost.difference:.0e}".replace("-", "−") + " *" * (not cost.is_same)]


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures."""
    return {"factors": factors}


def factors(outcome: Outcome):
    """Bars of time by scene and part, and marks of memory."""
    scenes = list(dict.fromkeys(cost.scene for cost in outcome.costs))
    keys = {e: [k for k in PARTS if any((c.part, c.engine) == (k, e) for c in outcome.costs)] for e in _TITLES}
    heights = [len(keys[engine]) + 1 for engine in keys]
    figure, axes = subplots(
        2,
        len(scenes),
        height=0.27 * sum(heights) + 1.4,
        sharex=True,
        sharey="row",
        gridspec_kw={"height_ratios": heights},
    )
    for row, (engine, title) in zip(axes, _TITLES.items(), strict=True):
        for axis, scene in zip(row, scenes, strict=True):
            axis.axvline(1, color=MUTED, lw=0.8)
            for shift, work, colour in ((-0.2, "forward", ZEROTH), (0.2, "gradient", FIRST)):
                own = {c.part: c for c in outcome.costs if (c.scene, c.engine, c.work) == (scene, engine, work)}
                places = np.array([keys[engine].index(key) for key in own]) + shift
                ends = np.array([cost.time[1] for cost in own.values()])
                axis.barh(places, ends - 1, 0.38, left=1, color=colour, label=f"time, {work}")
                axis.plot(
                    [c.memory for c in own.values()],
                    places,
                    "D",
                    mfc="white",
                    mec=colour,
                    ms=4,
                    label=f"memory, {work}",
                )
            axis.set(xscale="log", title=scene.replace("_", " ") if engine == "mjx" else "")
            plain(axis.xaxis)
        row[0].set_yticks(range(len(keys[engine])), [PARTS[key].what for key in keys[engine]])
        row[0].invert_yaxis()
        row[0].set_ylabel(title)
    legend_below(figure, axes[0][0], 4)
    caption = (
        "Factor by which time (bars) and memory (diamonds) grow when a part is put back that is left out, of a motion and of its "
        "gradient. At 1 a part costs nothing."
    )
    return figure, "What each omission buys", caption
