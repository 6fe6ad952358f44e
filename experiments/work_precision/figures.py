"""The pictures: error against run time, one panel per scene, with what no other way beats."""

import functools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, power, subplots
from experiments.work_precision.outcome import (
    MG,
    MJX,
    NUM_ITERATIONS,
    ONSET,
    SINGLE_TOLERANCE,
    TIGHT_TOLERANCE,
    C,
    Course,
    Estimate,
    Outcome,
    Point,
    pareto_front,
)
from experiments.work_precision.report import lines

_COLOURS = {MG: ZEROTH, ONSET: "#cc79a7", MJX: FIRST, C: "#009e73"}
_ESTIMATORS = {
    "zeroth order": ZEROTH,
    "first order, discrete": FIRST,
    "first order, event": "#e69f00",
    "first order, onset": "#009e73",
    "α-order, onset": DEFAULT,
}
# How points of the motion are marked, by what is out of the ordinary about them, and how estimates of the gradient are.
_DASHED = (0, (4, 2))
_MARKS = {
    "Euler": {"marker": "o"},
    "implicitfast": {"marker": "s"},
    "RK4": {"marker": "^"},
    "float32": {"marker": "o", "mfc": "white", "ls": _DASHED},
    "looser tolerance": {"marker": "v", "mfc": "white"},
    "1 or 3 iterations": {"marker": "x"},
    "other cone": {"marker": "D", "mfc": "white", "ls": _DASHED},
}
_OTHERS = {"coarser step": "<", "finer step": ">", "softer contact": "D"}
_KNOWN = {"lw": 0.9, "ls": (0, (2, 3))}
# Errors of smooth motions in double precision fall to rounding; nobody chooses by what lies below this.
_SMALLEST = 1e-9
_LARGEST = 10.0
# An empty logarithmic axis has no limits of its own.
_ANY = (1e-3, 1.0)


def drawings(outcome: Outcome) -> Drawings:
    """Name two figures per scene."""
    return {
        f"{drawing.__name__}_{course.name}": functools.partial(drawing, course)
        for course in outcome.courses
        for drawing in (motion, gradient)
    }


def motion(course: Course, outcome: Outcome):
    """Error of the final state against wall time: libraries and integrators on the left, other settings of the solver right."""
    figure, axes = subplots(1, 2, height=4.3, sharey=True, sharex=True)
    tight = [one for one in course.in_batch() if _is_tight(one)]
    others = [one for one in course.points if one not in tight and one.variant.batch == tight[0].variant.batch]
    others = [one for one in others if one.variant.cone == course.cone or one.variant.integrator == "Euler"]
    _front(axes[0, 0], [(one.cost, max(one.error, _SMALLEST)) for one in tight])
    on_jax = _best([(one.cost, max(one.error, _SMALLEST)) for one in tight if one.library != C])
    axes[0, 0].plot(*on_jax.T, "o", mfc="none", mec=REFERENCE, ms=9, mew=0.9, zorder=3)
    is_empty = not any(one.error <= _LARGEST for one in course.points)
    for axis, shown in zip(axes[0], (tight, others), strict=True):
        for line in lines(shown).values():
            _motion_line(axis, line, _mark(line[0], course))
        for library in (MG, C):
            axis.axhline(max(course.floor(library), _SMALLEST), color=_COLOURS[library], zorder=0, **_KNOWN)
        axis.set(xscale="log", yscale="log", xlabel="wall-clock seconds per simulated second and state")
        axis.set_xlim(_ANY if is_empty else None)
    axes[0, 0].set_ylabel("error of the final state, relative")
    axes[0, 0].set_title("integrator, precision, time step")
    axes[0, 1].set_title("solver tolerance and iterations, the other cone")
    finite = [min(max(one.error, _SMALLEST), _LARGEST) for one in course.points if np.isfinite(one.error)]
    axes[0, 0].set_ylim(min(*finite, 1e-3, 1e-3) / 2, max(*finite, 1e-1, 1e-1) * 2)
    marks = {_mark(one, course) for one in (*tight, *others)}
    handles = [Line2D([], [], color=colour, lw=2, label=name) for name, colour in _COLOURS.items()]
    handles += [
        Line2D([], [], **{"color": MUTED, "ls": "", "ms": 5, "label": name, **look})
        for name, look in _MARKS.items()
        if name in marks
    ]
    handles.append(Line2D([], [], mec=REFERENCE, mfc="none", marker="o", ls="", ms=9, label="none on JAX is better"))
    caption = (
        f"Error of the final state, root mean square over {outcome.settings.sizes.batch} starts in one batch, against wall "
        "time: the larger of the distance of positions (m and rad, Euclidean) over the way gone and that of velocities over "
        "the speed. Along a line the time step gets smaller to the right; bars are the range over repetitions. Left: the "
        f"solver run to {TIGHT_TOLERANCE:g} (float32: {SINGLE_TOLERANCE:g}), the scene's own cone; no other beats the broad "
        "grey line, none on JAX the rings. Right: loose tolerances at the two coarsest steps, few iterations, and the other "
        "cone beside its own reference. Dotted: how far the reference moved when its step was last halved; grey: errors that "
        "settings are recommended for."
    )
    return _finished(figure, axes[0], handles, outcome, course, "motion", caption)


def gradient(course: Course, outcome: Outcome):
    """Error of the estimate against its wall time, and against its rollouts."""
    figure, axes = subplots(1, 2, height=4.3, sharey=True)
    estimates = [one for one in course.estimates if np.isfinite(one.error)]
    reference = course.gradient_reference
    known = np.hypot(reference.standard_error, reference.step_error)
    for axis, cost in zip(axes[0], ("cost", "num_samples"), strict=True):
        _front(axis, [(getattr(one, cost), one.error) for one in estimates])
        for line in lines(estimates).values():
            _gradient_line(axis, line, [getattr(one, cost) for one in line], _other(line[0], course))
        axis.axhline(max(known, 1e-6), color=REFERENCE, zorder=0, **_KNOWN)
        axis.set(xscale="log", yscale="log", xlim=None if estimates else _ANY)
    axes[0, 0].set(xlabel="wall-clock seconds of one estimate", ylabel="error of the gradient, relative")
    axes[0, 1].set(xlabel="rollouts of one estimate")
    if ticks := sorted({one.num_samples for one in estimates}):
        axes[0, 1].set_xticks(ticks, [str(tick) for tick in ticks])
        axes[0, 1].minorticks_off()
    errors = [one.error for one in estimates]
    low = np.nanmin([*errors, known, *outcome.settings.targets])
    axes[0, 0].set_ylim(max(low / 2, 1e-6), min(max([*errors, 1.0]) * 1.6, 1e4))
    present = {one.estimator for one in estimates} | {_other(one, course) for one in estimates}
    handles = [Line2D([], [], color=c, marker="o", ms=4, label=n) for n, c in _ESTIMATORS.items() if n in present]
    handles += [
        Line2D([], [], color=MUTED, lw=0.8, alpha=0.8, marker=marker, ms=4, label=label)
        for label, marker in _OTHERS.items()
        if label in present
    ]
    caption = (
        "Error of a gradient estimate, root mean square over 64 repetitions, over the reference's norm, against the wall "
        "time of its rollouts (left) and their number (right). Two velocities of the start are the parameters, under "
        "Gaussian noise; the outcome is a weighted sum of final positions. Thick: the scene's own time step and contact, "
        "bars from the lower to the upper quartile; thin: other steps and softer contacts, whose error against the true "
        "scene levels off at their bias."
    )
    return _finished(figure, axes[0], handles, outcome, course, "gradient", caption)


def _finished(
    figure, axes: Sequence[Axes], handles: list[Line2D], outcome: Outcome, course: Course, kind: str, caption: str
):
    """Draw the targets and the legend; the caption is the first scene's, and the same for all."""
    for axis in axes:
        for target in outcome.settings.targets:
            axis.axhline(target, color=MUTED, lw=0.6, alpha=0.7, zorder=0)
    # No numbers between powers of ten but at 2 and 5, which leaves room for them.
    axes[0].xaxis.set_minor_formatter(FuncFormatter(_at_2_and_5))
    handles += [
        Line2D([], [], color=REFERENCE, lw=4.5, alpha=0.13, label="none is better"),
        Line2D([], [], color=MUTED, label="known of the reference", **_KNOWN),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8.5)
    figure.suptitle(course.title, fontsize=10.5)
    return figure, f"{course.title}: {kind}", caption if course is outcome.courses[0] else "As above."


def _is_tight(point: Point) -> bool:
    tight = SINGLE_TOLERANCE if point.variant.precision == "float32" else TIGHT_TOLERANCE
    return point.knobs.tolerance <= tight and point.variant.iterations >= NUM_ITERATIONS


def _mark(point: Point, course: Course) -> str:
    if point.variant.cone != course.cone:
        return "other cone"
    if point.variant.iterations < NUM_ITERATIONS:
        return "1 or 3 iterations"
    if not _is_tight(point):
        return "looser tolerance"
    return "float32" if point.variant.precision == "float32" else point.variant.integrator


def _motion_line(axis: Axes, line: Sequence[Point], mark: str) -> None:
    shown = sorted((one for one in line if one.error <= _LARGEST), key=lambda one: one.knobs.timestep)
    if not shown:
        return
    colour = _COLOURS[shown[0].library]
    costs, errors = np.array([one.cost for one in shown]), np.array([max(one.error, _SMALLEST) for one in shown])
    reach = np.array([costs - [min(one.seconds) for one in shown], [max(one.seconds) for one in shown] - costs])
    marker = _MARKS[shown[0].variant.integrator if mark == "float32" else mark]["marker"]
    is_open = "mfc" in _MARKS[mark]
    axis.plot(costs, errors, color=colour, lw=1.1, ls="--" if is_open else "-")
    axis.errorbar(
        costs, errors, xerr=reach, fmt=marker, color=colour, ms=4.5,
        mfc="white" if is_open else colour, elinewidth=0.7, alpha=0.9,
    )  # fmt: skip


def _front(axis: Axes, places: list[tuple[float, float]]) -> None:
    axis.step(*_best(places).T, where="post", color=REFERENCE, lw=4.5, alpha=0.13, zorder=0)


def _best(places: list[tuple[float, float]]) -> np.ndarray:
    """Give the points on the front in order of cost; none if all has diverged."""
    points = np.array(places).reshape(-1, 2)
    return np.array(sorted(map(tuple, points[pareto_front(*points.T)]))).reshape(-1, 2)


def _other(one: Estimate, course: Course) -> str | None:
    """Say what about an estimate is not the scene's own."""
    if one.softening != 1:
        return "softer contact"
    if one.timestep == course.timestep:
        return None
    return "coarser step" if one.timestep > course.timestep else "finer step"


def _gradient_line(axis: Axes, line: Sequence[Estimate], places: list[float], other: str | None) -> None:
    colour, errors = _ESTIMATORS[line[0].estimator], [one.error for one in line]
    if other is not None:
        axis.plot(places, errors, color=colour, lw=0.7, marker=_OTHERS[other], ms=3.5, mfc="white", alpha=0.65)
        return
    axis.plot(places, errors, color=colour, lw=1.6, marker="o", ms=5)
    low, high = np.array([one.spread for one in line]).T
    axis.vlines(places, low, high, color=colour, lw=3.5, alpha=0.25)


def _at_2_and_5(value: float, _: int | None) -> str:
    exponent = int(np.floor(np.log10(value) + 1e-9))
    digit = round(value / 10.0**exponent)
    return power(digit * 10.0**exponent) if digit in (2, 5) else ""
