"""The pictures of the experiment on the thrown cube."""

import numpy as np
from matplotlib.axes import Axes

from experiments.cube_toss.outcome import METHODS, Course, Outcome, Point
from experiments.theme import FIRST, MUTED, ZEROTH, Drawings, power, subplots

_LOOKS = {
    "discrete": (FIRST, "o"),
    "event": (ZEROTH, "s"),
    "continuous": ("#009e73", "D"),
    "substeps": ("#cc79a7", "^"),
    "adaptive": ("#e69f00", "v"),
    "quotient": ("#56b4e9", "P"),
}
# DiffMJX's own table (one run each, other hardware): name, relative error to its reference, seconds.
DIFFMJX = (("Euler 1 ms", 17.77, 3.29), ("Euler 30 µs", 0.0277, 102.5), ("Bosh3 1e-5", 0.0187, 9.20))
_CONTACTS = {"published": "Force begins continuously (d₀ = 0)", "default": "Force jumps (MuJoCo's default, d₀ = 0.9)"}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"error": error, "bias": bias}


def error(outcome: Outcome):
    """Error of a single derivative against processor time, one panel per contact."""
    figure, axes = subplots(1, len(outcome.courses), height=4.6, sharey=True)
    for axis, course in zip(axes[0], outcome.courses, strict=True):
        for method, label in METHODS.items():
            points = _finite(course, method)
            colour, marker = _LOOKS[method]
            axis.plot(
                [point.seconds for point in points],
                [course.error(point) for point in points],
                color=colour, marker=marker, ms=5, lw=1.3, label=label,
            )  # fmt: skip
        if course.contact == "published":
            for name, value, seconds in DIFFMJX:
                axis.plot(seconds, value, "x", color=MUTED, ms=6, mew=1.5)
                axis.annotate(
                    f"DiffMJX, {name}",
                    (seconds, value),
                    (-4, 6),
                    textcoords="offset points",
                    fontsize=8,
                    color=MUTED,
                    ha="right",
                )
        axis.axhline(outcome.settings.target_error, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set(title=_CONTACTS[course.contact], xlabel="processor time of one derivative, s")
    axes[0, 0].set_ylabel("relative error of one derivative")
    _legend(figure, axes[0, 0])
    settings = outcome.settings
    caption = (
        f"Root-mean-square error of a single derivative over {settings.num_throws} throws, as a share of the derivative, "
        "against processor time of one derivative without compilation. Along a line the time step or the tolerance gets "
        "smaller to the right. Grey: what DiffMJX published for its own simulator, on other hardware and against its own "
        "reference. The dotted line is the error that the verdict asks for."
    )
    return figure, "Error against time", caption


def bias(outcome: Outcome):
    """Mean and single errors of the methods of fixed step against the step."""
    figure, axes = subplots(1, len(outcome.courses), height=4.0, sharey=True)
    for axis, course in zip(axes[0], outcome.courses, strict=True):
        axis.axhline(0, color=MUTED, lw=0.8)
        for method in ("discrete", "event", "continuous", "substeps"):
            points = _finite(course, method)
            colour, marker = _LOOKS[method]
            steps = [point.setting for point in points]
            errors = np.array([point.error for point in points]) / course.scale
            axis.plot(steps, errors, color=colour, lw=0.5, alpha=0.5)
            axis.plot(steps, errors.mean(axis=1), color=colour, marker=marker, ms=5, label=METHODS[method])
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=0.01)
        ticks = sorted({point.setting for point in course.points if point.method == "discrete"})
        axis.set_xticks(ticks, [power(tick) for tick in ticks])
        axis.minorticks_off()
        axis.set(title=_CONTACTS[course.contact], xlabel="time step, s")
    axes[0, 0].set_ylabel("error of the derivative, relative")
    _legend(figure, axes[0, 0])
    settings = outcome.settings
    caption = (
        f"Mean error over the throws (thick), and single throws (thin). A mean over {settings.num_throws} throws is what "
        "noise on the throw would leave. Errors within ±1 % are drawn to scale, larger ones by their logarithm."
    )
    return figure, "Bias and spread", caption


def _finite(course: Course, method: str) -> list[Point]:
    found = sorted(course.of(method), key=lambda point: -point.setting)
    return [point for point in found if np.isfinite(course.error(point))]


def _legend(figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8.5)
