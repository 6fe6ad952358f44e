"""The answer of an experiment on error against run time: words, a table, a picture per scene."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments.report import Table, tabulated
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, logarithmic, subplots
from experiments.words import joined, percent, quantity
from experiments.work_precision.measure import MG, MJX, ONSET, C, Course, Estimate, Outcome, Point
from experiments.workspace import num_cores

_One = TypeVar("_One", Point, Estimate)


class Choice(NamedTuple):
    """What to take for a gradient: the way, the samples that it needs, and the time that one estimate then takes (s)."""

    estimate: Estimate
    num_samples: float
    seconds: float


def lines(measured: Iterable[_One]) -> list[list[_One]]:
    """Gather what differs in time step, or in the number of samples, alone."""
    found: dict[Any, list[_One]] = {}
    for one in measured:
        found.setdefault(one.variant if isinstance(one, Point) else (one.estimator, one.timestep), []).append(one)
    return list(found.values())


def fastest(points: Iterable[Point], target: float) -> Point | None:
    """Return the fastest point from which on its line stays below an error; None if there is none.

    One coarse point that is right by luck, between finer ones that are not, does not count.
    """
    found = []
    for line in lines(points):
        for point in sorted(line, key=lambda one: one.timestep):
            if not point.error <= target:
                break
            found.append(point)
    return min(found, key=lambda one: one.cost, default=None)


def samples_for(one: Estimate, target: float) -> float:
    """Return how many samples bring the error to a target, were bias and variance per sample to stay; or infinity."""
    room = target**2 - one.bias**2
    return max(2.0, np.ceil(one.variance * one.num_samples / room)) if room > 0 else np.inf


def cheapest(estimates: Iterable[Estimate], target: float) -> Choice | None:
    """Return the estimate that reaches an error in the least time, its samples made as many as that takes; or None.

    Of those that differ in the number of samples alone the largest speaks, for it knows its bias best.
    """
    choices = []
    for line in lines(estimates):
        one = max(line, key=lambda each: each.num_samples)
        count = samples_for(one, target)
        # A bias is not known better than this: what chance could hide of it has to fit as well.
        if np.isfinite(count) and one.bias_error <= target:
            choices.append(Choice(one, count, one.cost * count / one.num_samples))
    return min(choices, key=lambda one: one.seconds, default=None)


def answer(outcome: Outcome) -> str:
    """Give the price of an error of the motion, and what gets a gradient to it soonest."""
    target = max(outcome.settings.targets)
    costs = sorted(one.cost for course in outcome.courses if (one := _best(course, MG, target)) is not None)
    if not costs:
        return f"No setting is known to reach {percent(target)} of the motion."
    ways = Counter(
        one.estimate.estimator for course in outcome.courses if (one := cheapest(course.estimates, target)) is not None
    )
    span = "–".join(dict.fromkeys(map(_milliseconds, (costs[0], costs[-1]))))
    motion = f"{percent(target)} error: {span} ms a second on {len(costs)} of {len(outcome.courses)} scenes"
    soonest = f"; gradients: {ways.most_common(1)[0][0]}" if ways else ""
    return f"{motion}{soonest}."


def verdict(outcome: Outcome) -> str:
    """Say how the libraries stand at the largest target, over all scenes."""
    target = max(outcome.settings.targets)
    times = []
    for other, name in ((MJX, "mjx.step"), (C, f"C MuJoCo on {_threads()}")):
        pairs = [(_best(course, MG, target), _best(course, other, target)) for course in outcome.courses]
        if ratios := [one.cost / two.cost for one, two in pairs if one is not None and two is not None]:
            reach = f" ({min(ratios):.2g} to {max(ratios):.2g} on {len(ratios)} scenes)" if len(ratios) > 1 else ""
            times.append(f"{np.median(ratios):.2g} times as long as {name}{reach}")
    choices = [cheapest(course.estimates, target) for course in outcome.courses]
    counts = Counter("no way" if choice is None else choice.estimate.estimator for choice in choices)
    ways = ", ".join(f"{name} ({count} of {len(choices)} scenes)" for name, count in counts.most_common())
    motion = f"mg.step takes {joined(times)}" if times else "no two libraries can be compared"
    return f"For {percent(target)} error of the motion {motion}. The same of the gradient is soonest reached by {ways}."


def findings(outcome: Outcome) -> list[str]:
    """Say what is not known."""
    lost = [one.title for one in outcome.courses if not all(each.converges for each in one.references.values())]
    sentence = "Halving the step did not bring the reference nearer, so that the dotted line is all that is known"
    return [f"{sentence}: {'; '.join(lost)}."] if lost else []


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate what to take for which error, scene by scene."""
    targets = sorted(outcome.settings.targets, reverse=True)
    rows = []
    for course in outcome.courses:
        row = {
            "scene": course.title,
            "reference known to": _share(course.floor(MG)),
            "to compile mg.step; mjx.step, s": "; ".join(f"{course.compile_seconds[one]:.1f}" for one in (MG, MJX)),
        }
        for target in targets:
            best, share = [_best(course, name, target) for name in (MG, MJX, C)], percent(target)
            nothing = "?" if course.floor(MG) > target else "–"
            if (own := best[0]) is not None:
                nothing = f"{own.variant.integrator}, {own.variant.precision}, {1e3 * own.timestep:g} ms"
            row[f"motion to {share}"] = nothing
            costs = "; ".join("–" if one is None else _milliseconds(one.cost) for one in best)
            row[f"ms per s; mjx.step; C MuJoCo, to {share}"] = costs
            row[f"gradient to {share}"] = _choice(cheapest(course.estimates, target))
        rows.append(row)
    caption = (
        "What reaches an error in the least time: of the motion by mg.step, with milliseconds per simulated second of one "
        f"state in a batch of {outcome.settings.sizes.batch}, beside the fastest of mjx.step and of C MuJoCo on "
        f"{_threads()}; of the gradient, with its rollouts, as many as bias and variance call for, and their time. A dash: "
        "no setting gets there; a question mark: the reference is not known so well."
    )
    return [tabulated(rows, caption)]


def _best(course: Course, library: str, target: float) -> Point | None:
    """Return the fastest way of a library, unless the reference is not known that well."""
    if course.floor(library) > target:
        return None
    return fastest((point for point in course.points if point.variant.library == library), target)


def _choice(choice: Choice | None) -> str:
    if choice is None:
        return "–"
    one = choice.estimate
    count = f"{choice.num_samples:.0f}" if choice.num_samples < 1e4 else quantity(choice.num_samples)
    seconds = f"{_milliseconds(choice.seconds)} ms" if choice.seconds < 10 else f"{choice.seconds:.0f} s"
    return f"{one.estimator}, {1e3 * one.timestep:g} ms, {count} rollouts, {seconds}"


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.2g}" if seconds < 1e-2 else f"{1e3 * seconds:.0f}"


def _threads() -> str:
    return f"{num_cores()} threads" if num_cores() > 1 else "one thread"


def _share(share: float) -> str:
    """Write what smooth motions in double precision bring close to rounding."""
    if not np.isfinite(share):
        return "not finite"
    return "< 0.001%" if 0 < share < 1e-5 else percent(share)


_COLOURS = {MG: ZEROTH, ONSET: DEFAULT, MJX: FIRST, C: "#009e73"}
_ESTIMATORS = {
    "zeroth order": ZEROTH,
    "first order, discrete": FIRST,
    "first order, onset": "#009e73",
    "α-order, onset": DEFAULT,
}
_MARKERS = {"Euler": "o", "implicitfast": "s", "RK4": "^"}
_KNOWN = {"color": REFERENCE, "lw": 0.9, "ls": (0, (2, 3)), "zorder": 0}
# Errors of smooth motions in double precision fall to rounding; nobody chooses by what lies below this.
_SMALLEST, _LARGEST = 1e-9, 10.0


def drawings(outcome: Outcome) -> Drawings:
    """Draw a figure of all scenes, and one per scene."""
    return {"all_scenes": _all_scenes(outcome)} | {course.name: _drawn(course, outcome) for course in outcome.courses}


def _all_scenes(outcome: Outcome):
    """Draw the least time to each error, scene by scene: of the motion on the left, of the gradient on the right."""
    targets, count = sorted(outcome.settings.targets, reverse=True), len(outcome.courses)
    figure, axes = subplots(1, 2, height=1.6 + 0.4 * count, sharey=True)
    # Before a curve that may be empty, which a linear axis puts about zero.
    logarithmic(axes[0, 0].xaxis, axes[0, 1].xaxis)
    ways = dict.fromkeys(one.estimator for course in outcome.courses for one in course.estimates)
    for i, course in enumerate(outcome.courses):
        for axis, names, markers, shift in (
            (axes[0, 0], (MG, MJX, C), "oDs", 0.22),
            (axes[0, 1], ways, "osD^vP", 0.18),
        ):
            for j, (name, marker) in enumerate(zip(names, markers, strict=False)):
                is_motion = axis is axes[0, 0]
                place = i + shift * (j - 0.5 * (len(names) - 1))
                found = np.array([(_least(course, name, target, is_motion=is_motion), place) for target in targets])
                for part, look in (
                    (found, {"lw": 1.2}),
                    (found[:1], {"marker": marker, "ls": "", "ms": 6, "label": "_" if i else name}),
                    (found[1:], {"marker": marker, "ls": "", "ms": 4, "mfc": "white"}),
                ):
                    axis.plot(
                        *part[np.isfinite(part[:, 0])].T,
                        color=_COLOURS[name] if is_motion else _ESTIMATORS[name],
                        **look,
                    )
    for axis, title, side in zip(axes[0], ("motion", "gradient"), ("left", "right"), strict=True):
        what = "second of motion and state" if title == "motion" else "estimate"
        axis.set(title=f"time to an error of the {title}", xlabel=f"seconds per {what}")
        handles, labels = axis.get_legend_handles_labels()
        figure.legend(handles, labels, fontsize=8, loc=f"outside lower {side}", ncols=3)  # pyright: ignore[reportArgumentType]
    axes[0, 0].set_ylim(-0.6, count - 0.4)
    axes[0, 0].set_yticks(range(count), [course.title for course in outcome.courses])
    axes[0, 0].invert_yaxis()
    shown = " and ".join(
        f"{shape} {percent(target)}" for shape, target in zip(("full", "hollow"), targets, strict=False)
    )
    caption = (
        f"The least wall time to an error, {shown}, over all rules of integration, precisions and time steps; where a mark is "
        "missing, nothing that was tried gets there, or the reference is not known so well. Left is better. Gradients take as "
        "many rollouts as their bias and variance call for."
    )
    return figure, "All scenes", caption


def _least(course: Course, name: str, target: float, *, is_motion: bool) -> float:
    """Return the least seconds by a library, or by a way of estimating, to an error; NaN if it is not reached."""
    if is_motion:
        point = _best(course, name, target)
        return np.nan if point is None else point.cost
    choice = cheapest([one for one in course.estimates if one.estimator == name], target)
    return np.nan if choice is None else choice.seconds


def _drawn(course: Course, outcome: Outcome):
    """Draw error against wall time: of the final state on the left, of the gradient on the right."""
    figure, axes = subplots(1, 2, height=4.3)
    left, right = axes[0]
    for line in lines(course.points):
        variant = line[0].variant
        is_double = variant.precision == "float64"
        look = {"color": _COLOURS[variant.library], "marker": _MARKERS[variant.integrator], "ms": 4.5, "lw": 1.1}
        _line(left, line, **look, ls="-" if is_double else "--", mfc=None if is_double else "white")
    for line in lines(course.estimates):
        is_own = line[0].timestep == course.timestep
        look = {"color": _ESTIMATORS[line[0].estimator], "ms": 5, "marker": "o" if is_own else ">"}
        _line(right, line, **look, lw=1.6 if is_own else 0.7, mfc=None if is_own else "white")
    for axis, known, what in (
        (left, course.floor(MG), "seconds per simulated second and state"),
        (right, course.gradient_error, "seconds of one estimate"),
    ):
        axis.axhline(max(known, _SMALLEST), **_KNOWN)
        for target in outcome.settings.targets:
            axis.axhline(target, color=MUTED, lw=0.6, alpha=0.7, zorder=0)
        logarithmic(axis.xaxis)
        axis.set(yscale="log", xlabel=f"wall-clock {what}")
    left.set(title="error of the final state, relative", ylabel="error")
    right.set(title="error of the gradient, relative")
    names = {variant.integrator for variant in (one.variant for one in course.points)}
    handles = [Line2D([], [], color=colour, lw=2, label=name) for name, colour in _COLOURS.items()]
    handles += [Line2D([], [], color=MUTED, ls="", marker=_MARKERS[name], label=name) for name in sorted(names)]
    handles += [Line2D([], [], color=MUTED, ls="--", marker="o", mfc="white", label="float32")]
    left.legend(handles=handles, fontsize=7.5)
    present = {one.estimator for one in course.estimates}
    right.legend(
        handles=[Line2D([], [], color=c, marker="o", ms=4, label=n) for n, c in _ESTIMATORS.items() if n in present],
        fontsize=7.5,
    )
    caption = (
        f"Left, error of the final state, root mean square over {outcome.settings.sizes.batch} starts in one batch, against wall "
        "time: the larger of the distance of positions (m and rad, Euclidean) over the way gone and that of velocities over "
        "the speed. Along a line the time step gets smaller to the right. Right, error of a gradient estimate over 64 "
        "repetitions, over the reference's norm; along a line it takes more rollouts. Two velocities of the start are the "
        "parameters, under Gaussian noise; the outcome is a weighted sum of final positions. Thick: the scene's own time step. "
        "Dotted: what is known of the reference; grey: errors that settings are "
        "recommended for."
    )
    return figure, course.title, caption if course is outcome.courses[0] else "As above."


def _line(axis: Axes, line: Sequence[Point] | Sequence[Estimate], **look: Any) -> None:
    """Draw errors against costs; what has diverged is left out."""
    shown = sorted((one.cost, max(one.error, _SMALLEST)) for one in line if one.error <= _LARGEST)
    if shown:
        axis.plot(*zip(*shown, strict=True), **look)
