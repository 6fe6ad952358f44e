"""The pictures of an experiment on impacts."""

from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.landing.outcome import DISCRETE, EVENT, Course, Outcome
from experiments.report import Figure
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, save, subplots

_COLOURS = {DISCRETE: FIRST, EVENT: ZEROTH}


def draw(outcome: Outcome, folder: Path, captions: dict[str, str]) -> list[Figure]:
    """Draw all figures.

    Args:
        outcome: the numbers.
        folder: of the run.
        captions: of the figures, by name: derivative, error.

    Returns:
        The figures in order of reading.
    """
    figures = [
        Figure(
            save(derivative(group[0]), folder, f"derivative_{group[0].name}"),
            f"{group[0].title}: derivative against time",
            captions["derivative"] if number == 0 else captions["next"],
        )
        for number, group in enumerate(outcome.courses)
    ]
    return [Figure(save(error(outcome), folder, "error"), "Error of both derivatives", captions["error"]), *figures]


def derivative(course: Course):
    """One panel per coordinate: slope with its band, mean of each derivative, when something begins."""
    count, event = len(course.labels), course.found.gradients.index(EVENT)
    figure, axes = subplots(1, count, height=3.4)
    found = course.found
    for j, axis in enumerate(axes[0]):
        band = 2 * found.slope_error[:, j]
        axis.fill_between(
            course.times, found.slope[:, j] - band, found.slope[:, j] + band, color=MUTED, alpha=0.35, lw=0
        )
        axis.plot(course.times, found.slope[:, j], color=REFERENCE, lw=2.6)
        for row, name in enumerate(found.gradients):
            style = {"ls": (0, (4, 2))} if name == EVENT else {}
            axis.plot(course.times, found.mean[row, :, j], color=_COLOURS[name], lw=1.5, **style)
            wide = 2 * found.mean_error[row, :, j]
            below, above = found.mean[row, :, j] - wide, found.mean[row, :, j] + wide
            axis.fill_between(course.times, below, above, color=_COLOURS[name], alpha=0.18, lw=0)
        low, high = _window(course, j)
        axis.set_ylim(low, high)
        axis.plot(course.events, np.full(len(course.events), low), "|", color=MUTED, ms=9, clip_on=False)
        is_doubtful = ~course.can_judge[:, j]
        axis.plot(course.times[is_doubtful], found.slope[is_doubtful, j], "x", color=REFERENCE, ms=5)
        is_heavy = course.is_heavy[:, j] & course.can_judge[:, j]
        axis.plot(course.times[is_heavy], found.mean[event, is_heavy, j], "o", color=ZEROTH, mfc="white", ms=5)
        axis.set(title=course.labels[j], xlabel="time, s")
    axes[0, 0].set_ylabel("derivative with respect to the start")
    handles = [
        (Line2D([], [], color=REFERENCE, lw=2.6), "slope of the simulated outcome"),
        (Patch(color=MUTED, alpha=0.35), "± 2 standard errors, of each in its colour"),
        (Line2D([], [], color=FIRST), "discrete gradient"),
        (Line2D([], [], color=ZEROTH, ls=(0, (4, 2))), "event gradient"),
        (Line2D([], [], color=MUTED, marker="|", ls="", ms=9), "contact or limit begins"),
    ]
    if not course.can_judge.all():
        handles.append((Line2D([], [], color=REFERENCE, marker="x", ls="", ms=5), "slope too uncertain to judge by"))
    if (course.is_heavy & course.can_judge).any():
        handles.append(
            (Line2D([], [], color=ZEROTH, marker="o", mfc="white", ls="", ms=5), "mean hangs on a few starts")
        )
    figure.legend(*zip(*handles, strict=True), loc="outside lower center", ncols=3, fontsize=8.5)
    figure.suptitle(f"{course.title}, time step {1e3 * course.timestep:g} ms", fontsize=10)
    return figure


def error(outcome: Outcome):
    """Relative error over all times and coordinates: median and range, by motion and time step."""
    courses = outcome.all
    figure, axes = subplots(1, 1, height=1.8 + 0.3 * len(courses))
    axis = axes[0, 0]
    for place, course in enumerate(courses):
        judged = course.can_judge & course.has_impact
        for row, name in enumerate(course.found.gradients):
            errors = np.clip(course.found.relative_error[row][judged], 1e-4, 1e2)
            if not errors.size:
                continue
            at = place + (0.14 if name == EVENT else -0.14)
            axis.plot(errors, np.full(errors.size, at), ".", color=_COLOURS[name], ms=5, alpha=0.4, mec="none")
            axis.plot(np.median(errors), at, "o", color=_COLOURS[name], ms=8, mec="white")
    axis.axvline(outcome.settings.tolerance, color=MUTED, lw=1, ls=(0, (2, 3)))
    axis.set_yticks(range(len(courses)), [f"{c.title}, {1e3 * c.timestep:g} ms" for c in courses])
    axis.set_ylim(len(courses) - 0.5, -0.5)
    axis.set_xscale("log")
    axis.set_xlabel("error, as a share of the larger of the slope and the discrete gradient's own error")
    handles = [Line2D([], [], color=_COLOURS[n], marker="o", ls="", ms=5, label=f"{n} gradient") for n in _COLOURS]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8.5)
    return figure


def _window(course: Course, j: int) -> tuple[float, float]:
    """Show slope and event gradient whole, and of the discrete one what three times their range holds."""
    found = course.found
    event = found.mean[found.gradients.index(EVENT), :, j]
    inner = np.concatenate([found.slope[:, j], event[course.can_judge[:, j]], [0.0]])
    inner = inner[np.isfinite(inner)]
    reach = max(np.ptp(inner), 1e-6)
    shown = np.concatenate(
        [inner, np.clip(found.mean[:, :, j].ravel(), inner.min() - 2 * reach, inner.max() + 2 * reach)]
    )
    shown = shown[np.isfinite(shown)]
    pad = 0.06 * max(np.ptp(shown), 1e-6)
    return float(shown.min() - pad), float(shown.max() + pad)
