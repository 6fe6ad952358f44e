"""The referee: gradients of contact by several engines, each against the slope of its own outcome, and their time.

Each engine is installed by pip into an environment of its own, .cache/referee/<engine>, and asked by a program of
`referee_engines`, which simulates a scene from many starts and differentiates at each, one call at a time. The starts move a
contact through many time steps; the slope of the engine's outcomes over them is what its derivatives should be on average. An
engine that cannot be installed, or lacks what a scene needs, costs its rows and nothing else.
"""

import functools
import itertools
import json
import math
import os
import platform
import shutil
import subprocess
import sys
import threading
import tomllib
from collections import Counter
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from experiments.problems import ASSETS
from experiments.report import MOST_WORDS, Table
from experiments.settings import Positive, SettingsTable, SizedSettings
from experiments.theme import MARKERS, MUTED, OTHERS, REFERENCE, ZEROTH, Drawings, plain, subplots
from experiments.words import joined, percent, quantity
from experiments.workspace import Workspace, num_cores
from mjxgrad.diagnostics import compare_to_slope, phases

SceneName = Literal["bounce", "push", "slide", "peg", "hopper"]
EngineName = Literal["mjxgrad", "MJX", "MJX-softened", "brax", "Newton", "jaxsim", "Drake", "MuJoDiCo"]
_FOLDER, _CACHE = Path(__file__).parent / "referee_engines", Path(".cache/referee")
ENGINES: dict[str, dict[str, Any]] = tomllib.loads((_FOLDER / "engines.toml").read_text(encoding="utf-8"))
SCENES: dict[str, dict[str, Any]] = tomllib.loads((_FOLDER / "scenes.toml").read_text(encoding="utf-8"))
_INSTALL, _ANSWER = 900, 600  # s, after which an engine is given up
_RIGHT = 0.1  # relative error of a mean derivative that is called right
_LOW, _HIGH = 1e-4, 1e2  # errors in the picture


class Sizes(SettingsTable):
    """How much is measured."""

    scenes: Annotated[tuple[SceneName, ...], Field(min_length=1)]  # by name
    engines: Annotated[tuple[EngineName, ...], Field(min_length=1)]  # by name; those that are not there are installed
    num_starts: Annotated[int, Field(ge=32)]  # at which each engine is differentiated
    # Seconds of all gradients of a contestant in a scene, beyond which it is asked at fewer starts, 32 at least.
    budget: Positive


class Settings(SizedSettings):
    """Error of gradients through contact against their time, by engine."""

    sizes: Sizes


@dataclass(frozen=True)
class Cell:
    """One contestant in one scene, with errors over the size of the slope; times are median and quartiles."""

    scene: str
    engine: str
    variant: str
    num_starts: int
    num_finite: int
    outcome: float
    slope: float
    slope_error: float
    error: float  # of the mean derivative; infinite where not all are finite
    standard_error: float  # of `error`
    scatter: float  # standard deviation of single derivatives
    seconds: tuple[float, float, float]
    rollout_seconds: tuple[float, float, float]
    compile_seconds: float  # until the first gradient is there

    @property
    def is_right(self) -> bool:
        """Whether the mean derivative is known to be within a tenth of the slope."""
        return self.error <= _RIGHT and self.standard_error <= _RIGHT

    @property
    def label(self) -> str:
        """Engine and variant."""
        return f"{self.engine} {self.variant}"

    @property
    def brief(self) -> str:
        """Error and time, such as "2.6% ± 0.1%, 56 ms"."""
        return f"{self.told_error}, {1e3 * self.seconds[0]:.3g} ms"

    @property
    def told_error(self) -> str:
        """The error in words."""
        if not math.isfinite(self.error):
            return "no slope" if math.isnan(self.error) else "not finite"
        is_wild = max(self.error, self.standard_error) > _HIGH
        return f"{quantity(self.error)} times" if is_wild else f"{percent(self.error)} ± {percent(self.standard_error)}"


@dataclass(frozen=True)
class Outcome:
    """All cells, and a sentence on each that could not be had."""

    settings: Settings
    cells: list[Cell]
    missing: list[str]
    versions: dict[str, str]
    machine: str

    def rows(self) -> list[dict[str, Any]]:
        """One row per cell, for metrics.csv."""
        return [asdict(cell) | {"versions": self.versions[cell.engine], "machine": self.machine} for cell in self.cells]

    def soonest(self, scene: str) -> Cell | None:
        """Return the fastest contestant that is right, with the scene's own contact."""
        fit = (c for c in self.cells if c.scene == scene and c.is_right and "softened" not in ENGINES[c.engine])
        return min(fit, key=lambda cell: cell.seconds[0], default=None)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Ask every contestant about every scene."""
    sizes = settings.sizes
    asked = {name: scene for name, scene in scenes(sizes.num_starts).items() if name in sizes.scenes}
    contestants = [(name, variant) for name in sizes.engines for variant in ENGINES[name]["variants"]]
    parts = {" ".join(one): functools.partial(_judge, *one, asked, sizes.budget) for one in contestants}
    cells, missing, told = zip(*workspace.each("contestants", "contestants", parts), strict=True)
    versions = {name: version for (name, _), version in zip(contestants, told, strict=True)}
    gathered = list(itertools.chain(*cells)), list(dict.fromkeys(itertools.chain(*missing)))
    return Outcome(settings, *gathered, versions, _machine())


def scenes(num_starts: int) -> dict[str, dict[str, Any]]:
    """Return the scenes, with the values at which each is simulated."""
    own = {"hopper": {"xml": (ASSETS / "hopper.xml").read_text(encoding="utf-8")}}
    values = {name: phases(tuple(scene["interval"]), num_starts).tolist() for name, scene in SCENES.items()}
    return {name: scene | own.get(name, {}) | {"name": name, "values": values[name]} for name, scene in SCENES.items()}


def _judge(name: str, variant: str, asked: dict[str, Any], budget: float) -> tuple[list[Cell], list[str], str]:
    engine = ENGINES[name]
    request = {"scenes": asked, "variants": [variant], "packages": engine["packages"], "budget": budget}
    try:
        python = environment(name, engine["requires"])
    except (OSError, subprocess.SubprocessError) as error:
        why = (getattr(error, "stderr", None) or str(error)).strip().splitlines()[-1]
        return [], [f"{name}: not installed: {why}."], "not installed"
    versions, *answers = ask(python, _FOLDER / f"{engine['program']}.py", request) or [{}]
    nothing = {"error": f"no answer within {_ANSWER} s, or it crashed"}
    by_scene = dict.fromkeys(asked, nothing) | {one["scene"]: one for one in answers}
    missing = [f"{name} {variant}: no {s}: {one['error']}." for s, one in by_scene.items() if "error" in one]
    precision = engine.get("precision", "float64")
    cells = [cell(name, one, precision) for one in by_scene.values() if "error" not in one]
    return cells, missing, ", ".join(map(" ".join, versions.items()))


def environment(name: str, requires: list[str]) -> str:
    """Return the Python of an engine's environment, which is made anew if its list of packages has changed."""
    if not requires:
        return sys.executable
    folder = _CACHE / name
    python, mark = folder / "bin" / "python", folder / "requires.txt"
    if not mark.is_file() or mark.read_text(encoding="utf-8").splitlines() != requires:
        shutil.rmtree(folder, ignore_errors=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requires]
        for command in ([sys.executable, "-m", "venv", str(folder)], pip):
            subprocess.run(command, check=True, timeout=_INSTALL, capture_output=True, text=True)
        mark.write_text("\n".join(requires), encoding="utf-8")
    return str(python.absolute())


def ask(python: str, program: Path, request: dict[str, Any], limit: float = _ANSWER) -> list[dict[str, Any]]:
    """Return an engine's answers, those before it crashed or took longer than the limit (s)."""
    # Compilation is timed, so it is not taken from the disk.
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_COMPILATION", "PYTHONPATH"))}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([python, str(program)], env=kept, text=True, **pipes) as process:
        timer = threading.Timer(limit, process.kill)
        timer.start()
        told, _ = process.communicate(json.dumps(request))
        timer.cancel()
    return [json.loads(line) for line in told.splitlines() if line.startswith("{") and line.endswith("}")]


def cell(engine: str, answer: dict[str, Any], precision: str = "float64") -> Cell:
    """Compare the derivatives of one contestant with the slope of its outcomes."""
    found, outcomes = np.array(answer["derivatives"], float), np.array(answer["outcomes"], precision)
    is_finite = np.isfinite(found)
    compared = compare_to_slope(np.array(answer["values"]), outcomes, [np.where(is_finite, found, 0)], ["own"])
    slope = float(compared.slope)
    errors = [float(np.abs(one[0] / slope)) for one in (compared.error, compared.standard_error, compared.spread)]
    if abs(slope) <= float(compared.resolution):
        errors = 3 * [math.nan]
    elif not is_finite.all():
        errors = [math.inf, math.nan, math.nan]
    times = [np.quantile(answer[one], [0.5, 0.25, 0.75]).tolist() for one in ("gradient_seconds", "rollout_seconds")]
    numbers = len(found), int(is_finite.sum()), float(outcomes.mean()), slope, float(compared.slope_error)
    named = answer["scene"], engine, answer["variant"]
    parts: tuple[Any, ...] = (*named, *numbers, *errors, *map(tuple, times), answer["compile_seconds"])
    return Cell(*parts)


def _machine() -> str:
    text = about.read_text(encoding="utf-8") if (about := Path("/proc/cpuinfo")).is_file() else ""
    name = text.partition("model name")[2].partition("\n")[0].lstrip("\t: ") or platform.machine()
    return f"{num_cores()} cores of {name}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"


def answer(outcome: Outcome) -> str:
    """Say whose right gradient is soonest, scene by scene."""
    names = [cell.engine if (cell := outcome.soonest(scene)) else "nobody" for scene in outcome.settings.sizes.scenes]
    told = joined(f"{name} in {count}" for name, count in Counter(names).most_common())
    text = f"Right within {percent(_RIGHT)} and soonest: {told} of {len(names)} scenes."
    return text if len(text.split()) <= MOST_WORDS else f"{told}, of {len(names)}."


def verdict(outcome: Outcome) -> str:
    """Name the fastest right gradient of each scene, and how often each contestant is right."""
    names = outcome.settings.sizes.scenes
    found = [(scene, outcome.soonest(scene)) for scene in names]
    told = [f"{scene}: {f'{one.label} ({one.brief})' if one else 'nobody'}" for scene, one in found]
    count_of, right = (Counter(one.label for one in outcome.cells if one.is_right or every) for every in (True, False))
    most = [f"{label} in {count} of {count_of[label]}" for label, count in right.most_common()]
    return (
        f"The fastest gradient within {percent(_RIGHT)} of the slope of its engine's own outcome, by scene: {'; '.join(told)}. "
        f"Right are {', '.join(most) or 'none'}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say where it was measured, how engines were set, and what could not be had."""
    about = [f"{name} ({told}): {ENGINES[name]['settings']}." for name, told in outcome.versions.items()]
    return [f"Measured on {outcome.machine}, one call at a time.", *about, *outcome.missing]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate errors and times side by side, then all numbers."""
    names, by = outcome.settings.sizes.scenes, {(cell.label, cell.scene): cell for cell in outcome.cells}
    labels = list(dict.fromkeys(label for label, _ in by))
    short = [[label, *(by[label, s].brief if (label, s) in by else "–" for s in names)] for label in labels]
    places = {(labels.index(cell.label), names.index(cell.scene) + 1) for cell in outcome.cells if cell.is_right}
    questions = "; ".join(f"{name}, {SCENES[name]['question']}" for name in names)
    caption = (
        "Error of the mean derivative over the slope of the engine's own outcome, and time of one gradient. Bold: within "
        f"{percent(_RIGHT)}. Outcomes: {questions}."
    )
    columns = (
        "scene, contestant, outcome (m), slope, error, scatter, finite, gradient (ms), rollout (ms), first call (s)"
    )
    rows = []
    for cell in sorted(outcome.cells, key=lambda cell: names.index(cell.scene)):
        times = [f"{1e3 * m:.3g} ({1e3 * a:.3g} to {1e3 * b:.3g})" for m, a, b in (cell.seconds, cell.rollout_seconds)]
        numbers = [
            quantity(cell.outcome),
            quantity(cell.slope, cell.slope_error),
            cell.told_error,
            quantity(cell.scatter),
        ]
        numbers += [f"{cell.num_finite} of {cell.num_starts}", *times, f"{cell.compile_seconds:.1f}"]
        rows.append([cell.scene, cell.label, *numbers])
    about = "Errors with their standard errors, and scatter of single derivatives, over the slope. Times: median and quartiles."
    return [Table(("contestant", *names), short, caption, frozenset(places)), Table(columns.split(", "), rows, about)]


def drawings(outcome: Outcome) -> Drawings:
    """Draw the error of the mean derivative against seconds of one gradient, a panel per scene."""
    names = outcome.settings.sizes.scenes
    figure, axes = subplots(rows := len(names) // 3 + 1, 3, height=3.5 * rows, sharex=True, sharey=True)
    colours = dict(zip(ENGINES, (REFERENCE, ZEROTH, *OTHERS), strict=False))
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    for axis, name in zip(axes.flat, names, strict=False):
        for cell in (cell for cell in outcome.cells if cell.scene == name):
            look = {"color": colours[cell.engine], "label": cell.label}
            marker = MARKERS[ENGINES[cell.engine]["variants"].index(cell.variant)]
            ends = np.clip([cell.error - cell.standard_error, cell.error + cell.standard_error], _LOW, _HIGH)
            axis.plot([cell.seconds[0]] * 2, ends, color=look["color"], lw=0.8, alpha=0.5)
            axis.plot(cell.seconds[0], np.clip(cell.error, _LOW, _HIGH), ls="", ms=6, marker=marker, **look)
        axis.axhline(_RIGHT, color=MUTED, lw=0.8, ls=(0, (3, 2)))
        axis.set(xscale="log", yscale="log", title=name, ylim=(_LOW / 1.6, _HIGH * 1.6), xlabel="seconds of a gradient")
        axis.tick_params(labelbottom=True)
        plain(axis.xaxis)
    figure.supylabel("error over slope")
    named = {label: h for axis in axes.flat for h, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    axes.flat[-1].legend(named.values(), named.keys(), loc="center", fontsize=8, ncols=2)
    caption = (
        "Lower and further left is better; below the dashed line is right within a tenth. Errors above 100 and gradients that "
        "are not finite are at the top, errors below 10⁻⁴ at the bottom; bars are one standard error."
    )
    return {"error_against_time": (figure, "Error of the gradient against the time of one", caption)}
