"""The pictures: error against run time, one panel per scene, with what no other way beats."""

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, power, subplots
from experiments.work_precision.front import pareto_front
from experiments.work_precision.outcome import MG, MJX, NUM_ITERATIONS, ONSET, C, Course, Estimate, Outcome, Point

_COLOURS = {MG: ZEROTH, ONSET: "#cc79a7", MJX: FIRST, C: "#009e73"}
_MARKERS = {"Euler": "o", "implicitfast": "s", "RK4": "^"}
_ESTIMATORS = {
    "zeroth order": ZEROTH,
    "first order, discrete": FIRST,
    "first order, event": "#e69f00",
    "first order, onset": "#009e73",
    "α-order, onset": DEFAULT,
}
# Errors of smooth motions in double precision fall to rounding; nobody chooses by what lies below this.
_SMALLEST = 1e-9
_LARGEST = 10.0
# An empty logarithmic axis has no limits of its own.
_ANY = (1e-3, 1.0)
# The tolerance that single precision is given; what is beyond it is loose.
_RESOLVED = 1e-6


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
    tight = [one for one in course.in_batch() if _is_tight(one, outcome)]
    others = [one for one in course.points if one not in tight and one.batch == tight[0].batch]
    others = [one for one in others if one.cone == course.cone or one.integrator == "Euler"]
    _front(axes[0, 0], [one.cost for one in tight], [max(one.error, _SMALLEST) for one in tight])
    _ring(axes[0, 0], [one for one in tight if one.library != C])
    for axis, shown in zip(axes[0], (tight, others), strict=True):
        for line in _lines(shown):
            _motion_line(axis, line, _look(line[0], course, is_tight=line[0] in tight))
        for library in (MG, C):
            floor = max(course.floor(library), _SMALLEST)
            axis.axhline(floor, color=_COLOURS[library], lw=0.9, ls=(0, (2, 3)), zorder=0)
        for target in outcome.settings.targets:
            axis.axhline(target, color=MUTED, lw=0.6, alpha=0.7, zorder=0)
        has_line = any(one.error <= _LARGEST for one in course.points)
        limits = None if has_line else _ANY
        axis.set(xscale="log", yscale="log", xlabel="wall-clock seconds per simulated second and state", xlim=limits)
    axes[0, 0].set_ylabel("error of the final state, relative")
    axes[0, 0].set_title("integrator, precision, time step")
    axes[0, 1].set_title("solver tolerance and iterations, the other cone")
    _thin_ticks(axes[0, 0])
    _limit(axes[0, 0], [one.error for one in course.points])
    handles = _motion_legend(tight, others)
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8.5)
    figure.suptitle(course.title, fontsize=10.5)
    settings, sizes = outcome.settings, outcome.settings.sizes
    caption = (
        f"Error of the state after the motion's whole time, root mean square over {sizes.batch} starts, against wall time per "
        "simulated second and state, those starts simulated in one batch. Error: the larger of the distance of positions "
        "(mj_differentiatePos, in m and rad, Euclidean) over the way gone and that of velocities over the speed. Along a line "
        "the time step gets smaller to the right; bars are the range over repetitions. Left: the solver run to "
        f"{settings.tight_tolerance:g} (float32: 1e-6), the scene's own cone; the broad grey line is what no other beats, "
        "rings what no other on JAX does. Right: loose tolerances at the two coarsest steps, few iterations, and the other "
        "cone, compared with its own reference. Dotted: how far the reference itself moved when its step was last halved; "
        "below it nothing is known; it is left out where it is far below all errors. Grey: the errors that settings are "
        "recommended for. Compilation is apart, in the table."
    )
    return figure, f"{course.title}: motion", caption if course is outcome.courses[0] else "As above."


def gradient(course: Course, outcome: Outcome):
    """Error of the estimate against its wall time, and against its rollouts."""
    figure, axes = subplots(1, 2, height=4.3, sharey=True)
    estimates = [one for one in course.estimates if np.isfinite(one.error)]
    own = [one for one in estimates if one.timestep == course.timestep and one.softening == 1]
    costs = {"seconds": [one.cost for one in estimates], "rollouts": [one.num_samples for one in estimates]}
    for axis, (name, cost) in zip(axes[0], costs.items(), strict=True):
        _front(axis, cost, [one.error for one in estimates])
        for line in _lines(estimates):
            _gradient_line(axis, line, name, is_own=line[0] in own, own_step=course.timestep)
        axis.axhline(max(course.gradient_reference.error, 1e-6), color=REFERENCE, lw=0.9, ls=(0, (2, 3)), zorder=0)
        for target in outcome.settings.targets:
            axis.axhline(target, color=MUTED, lw=0.6, alpha=0.7, zorder=0)
        axis.set(xscale="log", yscale="log", xlim=None if estimates else _ANY)
    _thin_ticks(axes[0, 0])
    axes[0, 0].set(xlabel="wall-clock seconds of one estimate", ylabel="error of the gradient, relative")
    axes[0, 1].set(xlabel="rollouts of one estimate")
    ticks = sorted({one.num_samples for one in estimates})
    if ticks:
        axes[0, 1].set_xticks(ticks, [str(tick) for tick in ticks])
        axes[0, 1].minorticks_off()
    errors = [one.error for one in estimates]
    low = np.nanmin([*errors, course.gradient_reference.error, *outcome.settings.targets])
    axes[0, 0].set_ylim(max(low / 2, 1e-6), min(max([*errors, 1.0]) * 1.6, 1e4))
    present = {one.estimator for one in estimates}
    handles = [Line2D([], [], color=c, marker="o", ms=4, label=n) for n, c in _ESTIMATORS.items() if n in present]
    others = (
        ("<", "coarser step", any(one.timestep > course.timestep for one in estimates)),
        (">", "finer step", any(one.timestep < course.timestep for one in estimates)),
        ("D", "softer contact", any(one.softening != 1 for one in estimates)),
    )
    handles += [
        *(
            Line2D([], [], color=MUTED, lw=0.8, alpha=0.8, marker=marker, ms=4, label=label)
            for marker, label, is_drawn in others
            if is_drawn
        ),
        Line2D([], [], color=REFERENCE, lw=4.5, alpha=0.13, label="none is better"),
        Line2D([], [], color=REFERENCE, lw=0.9, ls=(0, (2, 3)), label="known of the reference"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8.5)
    figure.suptitle(course.title, fontsize=10.5)
    caption = (
        "Error of a gradient estimate, root mean square over 64 repetitions of its distance to the reference over the "
        "reference's norm, against the wall time of its rollouts (left) and their number (right). Two velocities of the start "
        "are the parameters, Gaussian noise on them smooths the outcome, a weighted sum of final positions. Thick: the "
        "scene's own time step and contact, bars from the lower to the upper quartile; thin: other steps and softer contacts, "
        "whose error against the true scene levels off at their bias. Zeroth order takes more rollouts with more parameters; "
        "these are two. Derivatives are taken forward, as the library does for up to three."
    )
    return figure, f"{course.title}: gradient", caption if course is outcome.courses[0] else "As above."


def _is_tight(point: Point, outcome: Outcome) -> bool:
    tight = outcome.settings.tight_tolerance
    tight = max(tight, _RESOLVED) if point.precision == "float32" else tight
    return point.tolerance <= tight and point.iterations >= NUM_ITERATIONS


def _lines(measured: Iterable[Any]) -> list[list[Any]]:
    lines: dict[tuple[Any, ...], list[Any]] = {}
    for one in measured:
        lines.setdefault(one.line, []).append(one)
    return list(lines.values())


def _motion_line(axis: Axes, line: Sequence[Point], look: tuple[str, str | None]) -> None:
    shown = sorted((one for one in line if one.error <= _LARGEST), key=lambda one: one.timestep)
    if not shown:
        return
    first = shown[0]
    colour = _COLOURS[first.library]
    costs, errors = np.array([one.cost for one in shown]), np.array([max(one.error, _SMALLEST) for one in shown])
    marker, face = look
    axis.plot(costs, errors, color=colour, lw=1.1, ls="--" if face == "white" else "-")
    low, high = (np.array([pick(one.seconds) for one in shown]) for pick in (min, max))
    axis.errorbar(
        costs, errors, xerr=np.array([costs - low, high - costs]), fmt=marker, color=colour, ms=4.5,
        mfc=face or colour, elinewidth=0.7, alpha=0.9,
    )  # fmt: skip


def _look(point: Point, course: Course, *, is_tight: bool) -> tuple[str, str | None]:
    if point.cone != course.cone:
        return "D", "white"
    if point.iterations < NUM_ITERATIONS:
        return "x", None
    if not is_tight:
        return "v", "white"
    return _MARKERS[point.integrator], "white" if point.precision == "float32" else None


def _motion_legend(tight: Sequence[Point], others: Sequence[Point]) -> list[Line2D]:
    libraries = [Line2D([], [], color=c, lw=2, label=f"{name}") for name, c in _COLOURS.items()]
    present = {one.integrator for one in tight}
    marks = [Line2D([], [], color=MUTED, marker=m, ls="", ms=5, label=n) for n, m in _MARKERS.items() if n in present]
    marks.append(Line2D([], [], color=MUTED, marker="o", mfc="white", ls=(0, (4, 2)), ms=5, label="float32"))
    if any(one.iterations >= NUM_ITERATIONS and one.cone == tight[0].cone for one in others):
        marks.append(Line2D([], [], color=MUTED, marker="v", mfc="white", ls="", ms=5, label="looser tolerance"))
    marks.append(Line2D([], [], color=MUTED, marker="x", ls="", ms=5, label="1 or 3 iterations"))
    if len({one.cone for one in others}) > 1:
        marks.append(Line2D([], [], color=MUTED, marker="D", mfc="white", ls=(0, (4, 2)), ms=5, label="other cone"))
    marks.append(Line2D([], [], color=REFERENCE, lw=4.5, alpha=0.13, label="none is better"))
    marks.append(Line2D([], [], mec=REFERENCE, mfc="none", marker="o", ls="", ms=9, label="none on JAX is better"))
    marks.append(Line2D([], [], color=MUTED, lw=0.9, ls=(0, (2, 3)), label="known of the reference"))
    return libraries + marks


def _front(axis: Axes, costs: Sequence[float], errors: Sequence[float]) -> None:
    best = np.array(_best(costs, errors)).reshape(-1, 2)
    axis.step(best[:, 0], best[:, 1], where="post", color=REFERENCE, lw=4.5, alpha=0.13, zorder=0)


def _best(costs: Sequence[float], errors: Sequence[float]) -> list[tuple[float, float]]:
    """Give the points on the front in order of cost; none if all has diverged."""
    on_front = pareto_front(costs, errors)
    return sorted((cost, error) for cost, error, keep in zip(costs, errors, on_front, strict=True) if keep)


def _ring(axis: Axes, points: Sequence[Point]) -> None:
    """Mark what no other way on JAX beats."""
    best = np.array(_best([one.cost for one in points], [max(one.error, _SMALLEST) for one in points])).reshape(-1, 2)
    axis.plot(best[:, 0], best[:, 1], "o", mfc="none", mec=REFERENCE, ms=9, mew=0.9, zorder=3)


def _gradient_line(axis: Axes, line: Sequence[Estimate], against: str, *, is_own: bool, own_step: float) -> None:
    first = line[0]
    colour = _ESTIMATORS[first.estimator]
    places = [one.cost if against == "seconds" else one.num_samples for one in line]
    errors = np.array([one.error for one in line])
    marker = "o" if is_own else "D" if first.softening != 1 else "<" if first.timestep > own_step else ">"
    axis.plot(
        places, errors, color=colour, lw=1.6 if is_own else 0.7, marker=marker,
        ms=5 if is_own else 3.5, mfc=colour if is_own else "white", alpha=1.0 if is_own else 0.65,
    )  # fmt: skip
    if is_own:
        low, high = np.array([one.spread for one in line]).T
        axis.vlines(places, low, high, color=colour, lw=3.5, alpha=0.25)


def _thin_ticks(axis: Axes) -> None:
    """Write no numbers between powers of ten but at 2 and 5, which leaves room for them."""
    axis.xaxis.set_minor_formatter(FuncFormatter(_at_2_and_5))


def _at_2_and_5(value: float, _: int | None) -> str:
    exponent = int(np.floor(np.log10(value) + 1e-9))
    digit = round(value / 10.0**exponent)
    return power(digit * 10.0**exponent) if digit in (2, 5) else ""


def _limit(axis: Axes, errors: Sequence[float]) -> None:
    finite = [min(max(one, _SMALLEST), _LARGEST) for one in errors if np.isfinite(one)]
    if finite:
        axis.set_ylim(min(*finite, 1e-3) / 2, max(*finite, 1e-1) * 2)
