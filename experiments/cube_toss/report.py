"""The answer of the experiment on the thrown cube: words, tables, pictures."""

import numpy as np

from experiments.cube_toss.measure import CONTACTS, METHODS, PUBLISHED_DERIVATIVE, Course, Outcome, Point
from experiments.report import Table
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, ZEROTH, Drawings, legend_below, power, subplots
from experiments.words import capitalised, joined, percent, quantity

# Share of the derivative that the verdict asks for.
TARGET = 0.02


def fastest(course: Course) -> Point | None:
    """Give the fastest point from which on its method stays below the target; None if there is none."""
    found = []
    for method in METHODS:
        # One lucky coarse point between bad ones does not count.
        for point in course.of(method):
            if course.error(point) > TARGET:
                break
            found.append(point)
    return min(found, key=lambda one: one.seconds, default=None)


def verdict(outcome: Outcome) -> str:
    """Say what reaches the wanted error soonest, and what never does."""
    return " ".join(_verdict(course) for course in outcome.courses)


def _verdict(course: Course) -> str:
    first, contact = fastest(course), CONTACTS[course.contact]
    best = {method: min((course.error(p) for p in course.of(method)), default=np.inf) for method in METHODS}
    never = [METHODS[method] for method in ("discrete", "adaptive") if best[method] > 0.2]
    if first is None:
        closest = min(best, key=lambda method: best[method])
        head = f"nothing stays below {TARGET:.0%}; the closest is {METHODS[closest]} ({_percent(best[closest])})"
    else:
        setting = f"tolerance {first.setting:g}"
        if first.method not in ("adaptive", "quotient"):
            setting = f"time step {first.setting:g} s"
        head = (
            f"the first below {TARGET:.0%} is {METHODS[first.method]} ({setting}): {_percent(course.error(first))} in "
            f"{first.seconds:.2g} s of processor time"
        )
    if never:
        head += f"; {joined(never)} {'stays' if len(never) == 1 else 'stay'} above 20% at every setting"
    return f"With {contact} {head}."


def findings(outcome: Outcome) -> list[str]:
    """Say what DiffMJX published."""
    return [
        f"DiffMJX published the derivative {PUBLISHED_DERIVATIVE:g} for these measures, and 1.9% error in 9.2 s after 67 s of "
        f"compilation; here it is {quantity(course.scale)} (C MuJoCo's steps of 10 µs give 0.571). That simulator softens "
        "collisions and lets contacts act from a distance, and ran on other hardware: its times stand beside ours, not for the "
        "same problem."
        for course in outcome.courses
        if course.contact == "published"
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all points."""
    rows, emphasised = [], set()
    for course in outcome.courses:
        first = fastest(course)
        for point in course.points:
            if point is first:
                emphasised.add((len(rows), 3))
            errors = map(_percent, (course.error(point), float(course.errors(point).mean())))
            costs = f"{point.seconds:.3g}", f"{point.first_seconds:.0f}", f"{point.num_steps:.0f}"
            rows.append([course.contact, METHODS[point.method], f"{point.setting:g}", *errors, *costs])
    columns = (
        "contact", "method", "time step (s) or tolerance", "error", "bias", "processor time, s", "first call, s", "steps"
    )  # fmt: skip
    caption = (
        "Error: root mean square over throws, of a single derivative, as a share of the derivative; bias: its mean. "
        "Reference: difference quotient of adaptive rollouts at tolerance 1e-10. The first call takes all throws and "
        "compiles, unless an earlier setting did or it was cached. Short steps at events are not counted. In bold the "
        f"fastest whose method stays below {TARGET:.0%} from there on."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _percent(share: float) -> str:
    return percent(share).replace("-", "−") if np.isfinite(share) else "failed"


_LOOKS = {
    "discrete": {"color": FIRST, "marker": "o"},
    "event": {"color": ZEROTH, "marker": "s"},
    "continuous": {"color": ONSET, "marker": "D"},
    "substeps": {"color": DEFAULT, "marker": "^"},
    "adaptive": {"color": "#e69f00", "marker": "v"},
    "quotient": {"color": "#56b4e9", "marker": "P"},
}
# DiffMJX's own table (one run each, other hardware): name, relative error to its reference, seconds.
DIFFMJX = (("Euler 1 ms", 17.77, 3.29), ("Euler 30 µs", 0.0277, 102.5), ("Bosh3 1e-5", 0.0187, 9.20))


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"error": error, "bias": bias}


def error(outcome: Outcome):
    """Error of a single derivative against processor time, one panel per contact."""
    figure, axes = subplots(1, len(outcome.courses), height=4.6, sharey=True)
    for axis, course in zip(axes[0], outcome.courses, strict=True):
        for method, label in METHODS.items():
            points = _finite(course, method)
            errors = [course.error(point) for point in points]
            axis.plot([point.seconds for point in points], errors, ms=5, lw=1.3, label=label, **_LOOKS[method])
        for name, value, seconds in DIFFMJX if course.contact == "published" else ():
            axis.plot(seconds, value, "x", color=MUTED, ms=6, mew=1.5)
            axis.annotate(
                f"DiffMJX, {name}", (seconds, value), (-4, 6),
                textcoords="offset points", fontsize=8, color=MUTED, ha="right",
            )  # fmt: skip
        axis.axhline(TARGET, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        axis.set(xscale="log", yscale="log", xlabel="processor time of one derivative, s")
    axes[0, 0].set_ylabel("relative error of one derivative")
    caption = (
        "Root-mean-square error of a single derivative over four throws, as a share of the derivative, against its processor "
        "time without compilation. Along a line the time step or the tolerance gets smaller to the right. Grey: what DiffMJX "
        "published for its own simulator, on other hardware and against its own reference. Dotted: the error that the "
        "verdict asks for."
    )
    return _finished(figure, axes[0], outcome), "Error against time", caption


def bias(outcome: Outcome):
    """Mean and single errors of the methods of fixed step against the step."""
    figure, axes = subplots(1, len(outcome.courses), height=4.0, sharey=True)
    for axis, course in zip(axes[0], outcome.courses, strict=True):
        axis.axhline(0, color=MUTED, lw=0.8)
        for method in ("discrete", "event", "continuous", "substeps"):
            points = _finite(course, method)
            steps, errors = [point.setting for point in points], np.array([course.errors(point) for point in points])
            axis.plot(steps, errors, color=_LOOKS[method]["color"], lw=0.5, alpha=0.5)
            axis.plot(steps, errors.mean(axis=1), ms=5, label=METHODS[method], **_LOOKS[method])
        axis.set(xscale="log", xlabel="time step, s")
        axis.set_yscale("symlog", linthresh=0.01)
        ticks = [point.setting for point in course.of("discrete")]
        axis.set_xticks(ticks, [power(tick) for tick in ticks])
        axis.minorticks_off()
    axes[0, 0].set_ylabel("error of the derivative, relative")
    caption = (
        "Mean error over the throws (thick), and single throws (thin). A mean over four throws is what noise on the throw "
        "would leave. Errors within ±1 % are drawn to scale, larger ones by their logarithm."
    )
    return _finished(figure, axes[0], outcome), "Bias and spread", caption


def _finite(course: Course, method: str) -> list[Point]:
    return [point for point in reversed(course.of(method)) if np.isfinite(course.error(point))]


def _finished(figure, axes: np.ndarray, outcome: Outcome):
    for axis, course in zip(axes, outcome.courses, strict=True):
        axis.set_title(capitalised(CONTACTS[course.contact]))
    legend_below(figure, axes[0], 3)
    return figure
