"""The pictures of the sawtooth."""

import functools
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, EVENT
from experiments.sawtooth.measure import Course, Outcome
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots

_COLOURS = {DISCRETE: FIRST, EVENT: ZEROTH, CONTINUOUS: "#009e73"}


def drawings(outcome: Outcome) -> Drawings:
    """Name a figure per motion, and the errors of all."""
    own = _own(outcome.courses)
    teeth = {f"teeth_{course.name}": functools.partial(_teeth, course, is_first=k == 0) for k, course in enumerate(own)}
    return {**teeth, "error": _errors}


def _own(courses: list[Course]) -> list[Course]:
    """Give each motion at one time step, the longest."""
    return list({course.name: course for course in reversed(courses)}.values())[::-1]


def _error(course: Course, arm: str) -> np.ndarray:
    """Give the error of the mean derivative over the slope."""
    found = course.arms[arm]
    return np.abs(found.error[0]) / np.maximum(np.abs(found.slope), found.resolution)


def _teeth(course: Course, _: Outcome, *, is_first: bool):
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
    text = caption if is_first else "As the figure before."
    return figure, course.title, text


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


def _errors(outcome: Outcome):
    """Draw how far each mean derivative is off the slope of its own outcome, motion by motion."""
    courses = outcome.courses
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
    return figure, "Error of the mean derivative", caption
