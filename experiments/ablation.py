"""What is left out of a step, put back piece by piece: what that costs in time, memory and compilation, by both engines."""

import dataclasses
import functools
import itertools
from dataclasses import dataclass
from timeit import timeit
from typing import Annotated, Any

import jax
import numpy as np
from pydantic import Field

from experiments.problems import left_out
from experiments.problems.left_out import ONLY_GRADIENT, PARTS, PartName, SceneName
from experiments.report import Table
from experiments.settings import SettingsTable, SizedSettings
from experiments.theme import FIRST, MUTED, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.words import joined, quantity
from experiments.workspace import Workspace
from mjxgrad.stepping import EngineName

_Count = Annotated[int, Field(ge=2)]
_ROUNDING = 100.0  # times what four roundings of the start make of a result: within that two programs give the same
_LEAST, _TOGETHER = 1.1, ("all", "mjx.step")  # a factor that counts; parts that are no single ones
_TITLES: dict[EngineName, str] = {"mjx": "MJX", "mujoco": "C MuJoCo"}


class Sizes(SettingsTable):
    """How much is measured."""

    # What MJX is given back in each scene; C MuJoCo, whose programs are small, is given back all that it leaves out.
    scenes: dict[SceneName, tuple[PartName, ...]]
    batch: _Count  # rollouts that MJX steps together
    few: _Count  # rollouts that C MuJoCo steps together
    horizon: _Count  # time steps of a rollout
    repeats: _Count  # turns, in each of which every program runs once


class Settings(SizedSettings):
    """Time, memory and results of scenes with parts put back."""

    sizes: Sizes
    # Scenes in place of the size's, with what MJX is given back in each.
    scenes: dict[SceneName, tuple[PartName, ...]] = Field(default_factory=dict)

    @property
    def chosen(self) -> dict[SceneName, tuple[PartName, ...]]:
        """The scenes to measure."""
        return self.scenes or self.sizes.scenes


@dataclass(frozen=True)
class Cost:
    """What a part costs that is put back into one program, over what that takes without it."""

    scene: str
    engine: EngineName
    part: str
    work: str
    time: tuple[float, float, float]  # quartiles and median over turns
    memory: float
    compilation: float
    seconds: float  # without the part, as the next two
    num_bytes: float
    compile_seconds: float
    difference: float  # largest change of a result, over the largest result
    rounding: float  # the same of a start that is moved by four roundings

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
    had_cache = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)  # compilation is measured, too
    try:
        parts = {name: functools.partial(of_scene, name, settings) for name in settings.chosen}
        return Outcome(settings, list(itertools.chain(*workspace.each("scenes", "scenes", parts))))
    finally:
        jax.config.update("jax_enable_compilation_cache", had_cache)


def of_scene(name: SceneName, settings: Settings) -> list[Cost]:
    """Measure one scene by both engines."""
    sizes, costs = settings.sizes, []
    by: dict[EngineName, tuple] = {"mjx": (settings.chosen[name], sizes.batch), "mujoco": (PARTS, sizes.few)}
    for engine, (chosen, count) in by.items():
        keys = [key for key in chosen if left_out.is_left_out(key, name, engine)]
        # Room is what `load_scene` keeps, unless it is told otherwise.
        variants = {"": []} | {k: [PARTS[k]] for k in keys}
        variants |= {"all": [PARTS[k] for k in keys if k != "room"]} if len(keys) > 2 else {}
        variants |= {"mjx.step": [PARTS["mjx.step"]]} if engine == "mjx" else {}
        starts = left_out.starts_of(left_out.file_of(name).compile(), count, sizes.horizon, settings.seed)
        for work in ("forward", "gradient"):
            own = {k: v for k, v in variants.items() if work == "gradient" or k not in ONLY_GRADIENT}
            costs += _compare(name, engine, work, own, starts, sizes.repeats)
    return costs


def _compare(name: str, engine: EngineName, work: str, variants: dict, starts: tuple, repeats: int) -> list[Cost]:
    """Let programs take turns, and compare what they take and give with the first one, which leaves all out."""
    traced = ((key, left_out.program(name, parts, engine, work, starts)) for key, parts in variants.items())
    made = {key: one.compiled() for key, one in traced if one is not None}  # one by one: two at a time take as long
    results = {key: _numbers(run(*starts)) for key, (run, *_) in made.items()}
    turns = [
        {k: timeit(functools.partial(run, *starts), number=1) for k, (run, *_) in made.items()} for _ in range(repeats)
    ]
    memory = {
        key: size + (left_out.peak(run, *starts) if engine == "mujoco" else 0) for key, (run, _, size) in made.items()
    }
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


def answer(outcome: Outcome) -> str:
    """Say which part buys most memory, and which most time."""
    memory = max(_single(outcome), key=lambda cost: cost.memory)
    took = max(_single(outcome), key=lambda cost: cost.time[1])
    told = ((memory, memory.memory, "memory"), (took, took.time[1], "time"))
    return "; ".join(f"{PARTS[c.part].what}: {factor:.3g}× {word} ({c.scene})" for c, factor, word in told) + "."


def verdict(outcome: Outcome) -> str:
    """Say what all parts cost together, and which cost nothing."""
    told, single = [], _single(outcome)
    for engine, part, title in (("mjx", "all", "MJX"), ("mujoco", "all", "C MuJoCo"), ("mjx", "mjx.step", "mjx.step")):
        spans = []
        for work, word in (("forward", "a motion"), ("gradient", "a gradient")):
            factors = [c.time[1] for c in outcome.costs if (c.part, c.engine, c.work) == (part, engine, work)]
            ends = dict.fromkeys(f"{end(factors):.2g}" for end in (min, max)) if factors else ()
            spans += [f"{' to '.join(ends)} times as long for {word}"] if ends else []
        told += [f"{title} takes {joined(spans)}"] if spans else []
    idle = {k for k in PARTS if all(c.time[0] < _LEAST and c.memory < _LEAST for c in single if c.part == k)}
    idle = [PARTS[k].what for k in PARTS if k in idle and any(c.part == k for c in single)]
    helps = dict.fromkeys(f"{PARTS[c.part].what} on {c.scene}" for c in single if c.time[2] < 1 / _LEAST)
    return (
        f"With all of it put back, by scene: {'; '.join(told)}. No cost anywhere: {joined(idle or ['nothing'])}. "
        f"Faster with than without: {joined(helps or ['nothing'])}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say where results differ beyond rounding, and what has no gradient."""
    told = []
    for key in dict.fromkeys(c.part for c in outcome.costs if not c.is_same):
        costs = [c for c in outcome.costs if c.part == key and not c.is_same]
        where, worst = joined(dict.fromkeys(c.scene for c in costs)), max(c.difference for c in costs)
        why = f" ({PARTS[key].off})" if PARTS[key].off else ""
        told.append(f"{PARTS[key].what}: results differ on {where}, by up to {quantity(worst)} of the largest{why}.")
    found = {(c.scene, c.work) for c in outcome.costs if c.part == "mjx.step"}
    lacks = [scene for scene, _ in found if (scene, "gradient") not in found]
    told += [f"mjx.step has no gradient in reverse mode on {joined(sorted(lacks))}."] if lacks else []
    return [*told, "All other results are the same to rounding."]


def _single(outcome: Outcome) -> list[Cost]:
    return [cost for cost in outcome.costs if cost.part not in _TOGETHER]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate each engine's factors."""
    found, sizes, order = [], outcome.settings.sizes, list(PARTS)
    scenes: list[str] = list(outcome.settings.chosen)
    for engine, title in _TITLES.items():
        costs = [cost for cost in outcome.costs if cost.engine == engine]
        costs.sort(key=lambda cost: (scenes.index(cost.scene), order.index(cost.part), cost.work))
        rows = [[c.scene, PARTS[c.part].what, PARTS[c.part].why, c.work, *_cells(c)] for c in costs]
        caption = (
            "Factors over the program without, whose own numbers the last rows of a scene tell: time with quartiles over turns, "
            "bold where these are above 1.1; memory beside arguments. Differences over the largest result; * beyond rounding. "
            f"{sizes.horizon} steps of {sizes.batch if engine == 'mjx' else sizes.few} rollouts."
        )
        columns = ("scene", f"back into {title}", "why not", "work", "time", "memory", "compilation", "difference")
        bold = frozenset((i, 4) for i, c in enumerate(costs) if c.time[0] > _LEAST)
        found.append(Table(columns, rows, caption, bold))
    return found


def _cells(cost: Cost) -> list[str]:
    low, middle, high = (f"{x:.3g}" for x in cost.time)
    without = (
        f" of {1e3 * cost.seconds:.3g} ms",
        f" of {cost.num_bytes / 1e3:.3g} kB",
        f" of {cost.compile_seconds:.2g} s",
    )
    ratios = (f"{middle} ({low} to {high})", f"{cost.memory:.3g}", f"{cost.compilation:.2g}")
    cells = [ratio + own * (cost.part in _TOGETHER) for ratio, own in zip(ratios, without, strict=True)]
    return [*cells, f"{cost.difference:.0e}".replace("-", "−") + " *" * (not cost.is_same)]


def drawings(outcome: Outcome) -> Drawings:
    """Draw bars of time by scene and part, and marks of memory."""
    scenes = list(dict.fromkeys(cost.scene for cost in outcome.costs))
    keys = {e: [k for k in PARTS if any((c.part, c.engine) == (k, e) for c in outcome.costs)] for e in _TITLES}
    heights = [len(keys[engine]) + 1 for engine in keys]
    shape = {"height": 0.27 * sum(heights) + 1.4, "sharex": True, "sharey": "row"}
    figure, axes = subplots(2, len(scenes), **shape, gridspec_kw={"height_ratios": heights})
    for row, (engine, title) in zip(axes, _TITLES.items(), strict=True):
        for axis, scene in zip(row, scenes, strict=True):
            axis.axvline(1, color=MUTED, lw=0.8)
            for shift, work, colour in ((-0.2, "forward", ZEROTH), (0.2, "gradient", FIRST)):
                own = {c.part: c for c in outcome.costs if (c.scene, c.engine, c.work) == (scene, engine, work)}
                places = np.array([keys[engine].index(key) for key in own]) + shift
                ends = np.array([cost.time[1] for cost in own.values()])
                axis.barh(places, ends - 1, 0.38, left=1, color=colour, label=f"time, {work}")
                look = {"mfc": "white", "mec": colour, "ms": 4, "label": f"memory, {work}"}
                axis.plot([cost.memory for cost in own.values()], places, "D", **look)
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
    return {"factors": (figure, "What each omission buys", caption)}
