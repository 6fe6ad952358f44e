"""The box crossing: loss against seconds of descents on a published task, beside the published engines."""

import functools
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import mujoco
import numpy as np
from pydantic import Field, PositiveInt

from experiments.problems.box_crossing import PUBLISHED, Descent, box_crossing, descend
from experiments.report import Table
from experiments.settings import Positive, RunSettings, SettingsTable, VideoSettings
from experiments.theme import REFERENCE, Drawings, legend_below, looks, subplots
from experiments.video import film
from experiments.words import capitalised, joined
from experiments.workspace import Workspace


class Method(SettingsTable):
    """One way to descend, by the arguments of `box_crossing` and `descend`."""

    label: str
    method: Literal["least_squares", "first_order", "alpha_order", "zeroth_order", "cross_entropy"]
    wheels: Literal["cylinder", "capsule"] = "cylinder"
    engine: Literal["mujoco", "mjx"] = "mujoco"
    gradient: Literal["discrete", "slope"] = "discrete"
    num_steps: PositiveInt
    num_samples: PositiveInt = 1
    stddev: Positive = 0.1
    learning_rate: Positive = 0.3


class Settings(RunSettings):
    """Descents, compared by when they reach a loss (m²) within some seconds; sizes count starts, and the first methods."""

    size: Literal["quick", "default"] = "default"
    sizes: dict[Literal["num_starts", "num_methods"], PositiveInt]
    goal: Positive = 0.074
    seconds: Positive = 15.0
    methods: Annotated[tuple[Method, ...], Field(min_length=1, max_length=12)]
    video: VideoSettings | None = VideoSettings(speed=1.0)


@dataclass(frozen=True)
class Outcome:
    """Descents by label, one per start; and the crossing of least loss when cylinders play what was found."""

    settings: Settings
    runs: dict[str, list[Descent]]
    mj_model: mujoco.MjModel
    qpos: np.ndarray

    def rows(self) -> list[dict[str, Any]]:
        """Give each point of each descent, for metrics.csv."""
        runs = [({"method": label, "start": i}, run) for label, runs in self.runs.items() for i, run in enumerate(runs)]
        names = ("seconds", "loss_m2", "gradient_norm")
        return [about | dict(zip(names, row, strict=True)) for about, run in runs for row in np.transpose(run[:3])]

    def found(self, label: str) -> np.ndarray:
        """Return per descent when it reaches the goal (s), infinite where not in time, and its least loss in time (m²)."""
        most, goal = self.settings.seconds, self.settings.goal
        in_time = [(run.seconds[run.seconds <= most], run.loss[run.seconds <= most]) for run in self.runs[label]]
        return np.array([(min(x[y <= goal], default=np.inf), np.fmin.reduce(y, initial=np.inf)) for x, y in in_time])


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend by every method from every start."""
    jax.config.update("jax_enable_compilation_cache", False)  # compilation is measured
    methods, count = settings.methods[: settings.sizes["num_methods"]], settings.sizes["num_starts"]
    parts = {one.label: functools.partial(_descents, one, count) for one in methods}
    runs = dict(zip(parts, workspace.each("descents", "methods", parts), strict=True))
    task = box_crossing()
    play = jax.jit(lambda params: task.trajectory(params).qpos)
    played = [np.asarray(play(run.params)) for found in runs.values() for run in found]
    losses = [np.sum((qpos[1:, :2] - task.target) ** 2) for qpos in played]
    return Outcome(settings, runs, task.scene.mj_model, played[np.nanargmin(losses)])


def _descents(one: Method, count: int) -> list[Descent]:
    given = one.model_dump(exclude={"label"})
    task = box_crossing(*(given.pop(name) for name in ("wheels", "engine", "gradient")))
    return [descend(task, seed=42 + i, **given) for i in range(count)]


def answer(outcome: Outcome) -> str:
    """Name the method that gets there soonest from its worst start."""
    label = min(outcome.runs, key=lambda label: tuple(outcome.found(label).max(axis=0)))
    return f"{capitalised(label)}: {outcome.found(label)[:, 0].max():.1f} s at worst; published, on a GPU: 10 s."


def verdict(outcome: Outcome) -> str:
    """Say what reaches the loss from every start."""
    times = {label: outcome.found(label)[:, 0].max() for label in outcome.runs}
    every = joined(f"“{label}” ({time:.1f} s)" for label, time in times.items() if np.isfinite(time)) or "none"
    return f"A loss of {outcome.settings.goal:g} m² within {outcome.settings.seconds:g} s from every start: {every}."


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents, then the published ones."""
    rows = []
    for label, runs in outcome.runs.items():
        cells = [" / ".join(f"{x:.3g}".replace("inf", "–") for x in found) for found in outcome.found(label).T]
        largest = max(np.nanmax(run.gradient_norm, initial=0) for run in runs)
        rows.append([label, *cells, f"{runs[0].compile_seconds:.1f}", f"{largest:.2g}"])
    rows += [[f"{name}, published", f"{x:g}", f"{y:g}", "", ""] for name, (x, y) in PUBLISHED.items()]
    columns = ("method", f"s to {outcome.settings.goal:g} m²", "least loss, m²", "s compiling", "largest |g|")
    return [Table(columns, rows, "By start; s without compilation. Published: s to the loss beside, on an RTX 3090.")]


def drawings(outcome: Outcome) -> Drawings:
    """Draw loss and gradient norm against seconds; colours by estimator, lines by wheels and engine."""
    figure, axes = subplots(1, 2, height=5.2, width_ratios=[3, 2])
    (left, right), times = axes[0], np.geomspace(0.1, outcome.settings.seconds, 400)
    kinds = [label.split(",")[0] for label in outcome.runs]
    unique = dict.fromkeys(kinds)
    colours = {kind: look["color"] for kind, look in zip(unique, looks(unique), strict=True)}
    for one, kind in zip(outcome.settings.methods, kinds, strict=False):
        style, runs = ":" if one.engine == "mjx" else "-" if one.wheels == "capsule" else "--", outcome.runs[one.label]
        worst = [max(np.fmin.reduce(run.loss[run.seconds <= time], initial=9) for run in runs) for time in times]
        left.plot(times, np.where(np.array(worst) < 9, worst, np.nan), style, label=one.label, color=colours[kind])
        for run in runs:
            right.plot(run.seconds, np.minimum(run.gradient_norm, 1e9), ".", color=colours[kind], ms=3)
    for name, at in PUBLISHED.items():
        left.plot(*at, "*", color=REFERENCE, ms=11, zorder=5)
        left.annotate(name, at, (0, 8), textcoords="offset points", ha="center", fontsize=8)
    left.axhline(outcome.settings.goal, color=REFERENCE, lw=0.8, ls=(0, (1, 2)), zorder=0)
    for axis, title in zip(axes[0], ("Least loss so far, m²", "Norm of the gradient or its estimate"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel="s, without compilation", title=title)
    legend_below(figure, left, 3)
    caption = "Left, of the worst start; stars are published, on an RTX 3090. Right, norms above 1e9 are at the edge."
    return {"loss": (figure, "Loss against seconds", caption)}


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the best crossing, and give the file and its caption."""
    caption = "The best of all that was found, played on cylinders."
    return film(workspace, [(outcome.mj_model, outcome.qpos)], wanted, camera="side", caption=caption)
