"""The experiment on the sawtooth: numbers, pictures, and what follows."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, EVENT
from experiments.report import Figure, Report, Table
from experiments.sawtooth.measure import Course, measure
from experiments.sawtooth.settings import SawtoothSettings
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, save, subplots
from experiments.workspace import Workspace

_COLOURS = {DISCRETE: FIRST, EVENT: ZEROTH, CONTINUOUS: "#009e73"}


def run(settings: SawtoothSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.
    """
    courses = measure(settings, workspace)
    return Report(
        verdict=_verdict(courses),
        details=_findings(courses),
        figures=[
            *[_teeth(course, workspace.folder, is_first=k == 0) for k, course in enumerate(_own(courses))],
            _errors(courses, workspace.folder),
        ],
        tables=[_table(courses)],
        metrics=[row for course in courses for row in _rows(course)],
    )


def _own(courses: list[Course]) -> list[Course]:
    """Give each motion at one time step, the longest."""
    return list({course.name: course for course in reversed(courses)}.values())[::-1]


def _pooled(courses: list[Course], values: Any) -> np.ndarray:
    return np.concatenate([np.broadcast_to(values(c), c.has_impact.shape)[c.has_impact] for c in courses])


def _ratio(course: Course) -> np.ndarray:
    return course.sawtooth(DISCRETE) / np.maximum(course.sawtooth(CONTINUOUS), np.finfo(float).tiny)


def _off(course: Course, arm: str) -> np.ndarray:
    """Give by how many of its standard errors the mean derivative is off the slope of its own outcome."""
    found = course.arms[arm]
    return np.abs(found.error[0]) / np.maximum(found.standard_error[0], found.resolution)


def _error(course: Course, arm: str) -> np.ndarray:
    """Give the error of the mean derivative over the slope."""
    found = course.arms[arm]
    return np.abs(found.error[0]) / np.maximum(np.abs(found.slope), found.resolution)


def _excess(course: Course, arm: str) -> np.ndarray:
    """Give the error beyond two standard errors, over the slope."""
    found = course.arms[arm]
    return np.maximum(np.abs(found.error[0]) - 2 * found.standard_error[0], 0) / np.maximum(
        np.abs(found.slope), found.resolution
    )


def _closer(course: Course) -> np.ndarray | None:
    """Give the error beside the converged motion over that of MuJoCo's step; None without a reference."""
    own, theirs = course.error(CONTINUOUS), course.error(DISCRETE)
    return None if own is None or theirs is None else own / theirs


def _verdict(courses: list[Course]) -> str:
    ratio, spread = _pooled(courses, _ratio), _pooled(courses, lambda c: c.spread(CONTINUOUS))
    if not ratio.size:
        return "Nothing touches in these motions: there are no teeth."
    off = {arm: float(np.mean(_pooled(courses, lambda c, a=arm: _off(c, a)) <= 2)) for arm in ARMS}
    return (
        f"The sawtooth is {np.median(ratio):.0f} times smaller in the median ({np.quantile(ratio, 0.1):.0f} at the tenth "
        f"percentile) when contacts begin within the step. The mean of the plain derivative is then the slope within two "
        f"standard errors at {off[CONTINUOUS]:.0%} of {ratio.size} readings ({off[DISCRETE]:.0%} without, {off[EVENT]:.0%} for "
        f"the event gradient), and single derivatives scatter by {np.median(spread):.2f} of it."
    )


def _findings(courses: list[Course]) -> list[str]:
    sentences = []
    beyond = [(course, _excess(course, CONTINUOUS)) for course in courses]
    worst = [f"{c.title}, {1e3 * c.timestep:g} ms" for c, e in beyond if (e[c.has_impact] > 0.05).any()]
    if worst:
        sentences.append(f"Some mean derivative is more than 5% beyond its error in {'; '.join(worst)}.")
    moved = _pooled(courses, lambda c: c.shift / c.sawtooth(DISCRETE))
    sentences.append(f"The mean outcome shifts by {np.median(moved):.2f} of MuJoCo's sawtooth in the median.")
    if all(c.reference is not None for c in courses):
        closer = _pooled(courses, _closer)
        sentences.append(
            f"Beside MuJoCo's motion at a step many times shorter its error is {np.median(closer):.2f} of MuJoCo's own in the "
            f"median, and larger at {np.mean(closer > 1):.0%} of the readings."
        )
    return sentences


def _table(courses: list[Course]) -> Table:
    rows = []
    for c in courses:
        if not c.has_impact.any():
            continue
        pick = c.has_impact
        row = [c.title, f"{1e3 * c.timestep:g}", f"{np.median(_ratio(c)[pick]):.0f} ({_ratio(c)[pick].min():.1f})"]
        row += [f"{np.median(c.spread(arm)[pick]):.2g}" for arm in ARMS]
        row += [f"{int((_off(c, arm)[pick] <= 2).sum())} of {int(pick.sum())}" for arm in ARMS]
        row.append(f"{np.median((c.shift / c.sawtooth(DISCRETE))[pick]):.2f}")
        closer = _closer(c)
        error = "–" if closer is None else f"{np.median(closer[pick]):.2f}"
        rows.append([*row, error])
    columns = ["motion", "time step, ms", "sawtooth smaller, times"]
    columns += [f"spread, {arm}" for arm in ARMS] + [f"within 2 errors, {arm}" for arm in ARMS]
    return Table(
        (*columns, "shift of the mean", "error"),
        rows,
        "Medians over times and coordinates with an impact before them; in brackets the least. Spread: standard deviation of "
        "single derivatives about their trend, over the slope. Within 2 errors: readings where the mean derivative is the slope "
        "of its own outcome. Shift of the mean outcome over MuJoCo's sawtooth. Error beside the converged motion over "
        "MuJoCo's own.",
    )


def _teeth(course: Course, folder: Path, *, is_first: bool) -> Figure:
    """Draw the outcome less its trend and single derivatives over the start, and their mean over time."""
    count = len(course.labels)
    figure, axes = subplots(3, count, height=7.4)
    for j in range(count):
        _draw_starts(axes[0, j], axes[1, j], course, j)
        _draw_times(axes[2, j], course, j)
        axes[0, j].set_title(course.labels[j])
    for row, label in enumerate(("outcome less its trend", "derivative, each start", "derivative, mean")):
        axes[row, 0].set_ylabel(label)
    names = {
        DISCRETE: "MuJoCo's step; its derivative",
        EVENT: "event gradient",
        CONTINUOUS: "contact begins within the step",
    }
    handles = [Line2D([], [], color=_COLOURS[a], marker=".", label=names[a]) for a in ARMS]
    handles.append(Line2D([], [], color=REFERENCE, label="slope of the simulated outcome"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
    figure.suptitle(f"{course.title}, {course.times[-1]:.2f} s, time step {1e3 * course.timestep:g} ms", fontsize=10)
    caption = (
        "Above, where the motion ends up, less a smooth trend, against where it starts. In the middle, the derivative of each "
        "single rollout; the line is the slope of the outcome. Below, their mean against time. Derivatives far off are cut."
    )
    return Figure(
        save(figure, folder, f"teeth_{course.name}"), course.title, caption if is_first else "As the figure before."
    )


def _draw_starts(upper: Any, lower: Any, course: Course, j: int) -> None:
    """Draw one coordinate of the last reading over the start."""
    for arm in (DISCRETE, CONTINUOUS):
        upper.plot(course.arms[arm].parameters, course.residual(arm)[:, -1, j], color=_COLOURS[arm], lw=1.3)
    single = {arm: found.derivatives[0][:, -1, j] for arm, found in course.arms.items()}
    for arm, values in single.items():
        lower.plot(course.arms[arm].parameters, values, ".", color=_COLOURS[arm], ms=4)
    slope = course.arms[CONTINUOUS].slope[-1, j]
    lower.axhline(slope, color=REFERENCE, lw=1.2)
    _show(lower, np.append(np.quantile(np.concatenate([*single.values()]), [0.02, 0.98]), slope))
    upper.axhline(0, color=MUTED, lw=0.6)
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("start, m or rad")


def _draw_times(axis: Any, course: Course, j: int) -> None:
    """Draw the slope of one coordinate and the mean of each derivative over time."""
    slope = course.arms[CONTINUOUS].slope[:, j]
    axis.plot(course.times, slope, color=REFERENCE, lw=2.6)
    for arm, found in course.arms.items():
        mean, wide = found.mean[0, :, j], 2 * found.mean_error[0, :, j]
        axis.plot(course.times, mean, color=_COLOURS[arm], lw=1.3)
        axis.fill_between(course.times, mean - wide, mean + wide, color=_COLOURS[arm], alpha=0.15, lw=0)
    near = np.concatenate([slope, course.arms[CONTINUOUS].mean[0, :, j], [0.0]])
    reach = max(float(np.ptp(near)), 1e-9)
    means = np.concatenate([found.mean[0, :, j] for found in course.arms.values()])
    _show(axis, np.append(near, np.clip(means, near.min() - reach, near.max() + reach)))
    axis.set_xlabel("time, s")


def _show(axis: Any, values: np.ndarray) -> None:
    pad = 0.15 * max(float(np.ptp(values)), np.abs(values).max(), 1e-9)
    axis.set_ylim(values.min() - pad, values.max() + pad)


def _errors(courses: list[Course], folder: Path) -> Figure:
    """Draw how far each mean derivative is off the slope of its own outcome, motion by motion."""
    figure, axes = subplots(1, 1, height=1.6 + 0.32 * len(courses))
    axis = axes[0, 0]
    for place, course in enumerate(courses):
        for shift, arm in zip((-0.22, 0.0, 0.22), ARMS, strict=True):
            error = np.clip(_error(course, arm)[course.has_impact], 1e-4, 1e2)
            axis.plot(error, np.full(error.size, place + shift), ".", color=_COLOURS[arm], ms=4, alpha=0.4, mec="none")
            if error.size:
                axis.plot(np.median(error), place + shift, "o", color=_COLOURS[arm], ms=7, mec="white")
    axis.axvline(0.05, color=MUTED, lw=1, ls=(0, (2, 3)))
    axis.set_yticks(range(len(courses)), [f"{c.title}, {1e3 * c.timestep:g} ms" for c in courses])
    axis.set_ylim(len(courses) - 0.5, -0.5)
    axis.set_xscale("log")
    axis.set_xlabel("error of the mean derivative, over the slope")
    handles = [Line2D([], [], color=_COLOURS[arm], marker="o", ls="", ms=5, label=arm) for arm in ARMS]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8.5)
    caption = (
        "One dot per time and coordinate after the first impact, large ones the medians. Dotted, 5%. Sampling errors are part "
        "of it: where the slope is near zero all arms lie far to the right."
    )
    return Figure(save(figure, folder, "error"), "Error of the mean derivative", caption)


def _rows(course: Course) -> list[dict[str, Any]]:
    rows = []
    for i, j in np.ndindex(course.has_impact.shape):
        row: dict[str, Any] = {
            "case": course.name,
            "timestep": course.timestep,
            "time": float(course.times[i]),
            "outcome": course.labels[j],
            "has_impact": bool(course.has_impact[i, j]),
            "shift": float(course.shift[i, j]),
        }
        for arm, found in course.arms.items():
            error = course.error(arm)
            row |= {
                f"{arm} slope": float(found.slope[i, j]),
                f"{arm} mean": float(found.mean[0, i, j]),
                f"{arm} standard error": float(found.standard_error[0, i, j]),
                f"{arm} spread": float(course.spread(arm)[i, j]),
                f"{arm} sawtooth": float(course.sawtooth(arm)[i, j]),
                f"{arm} error": float("nan") if error is None else float(error[i, j]),
            }
        rows.append(row)
    return rows
