"""The answer: words, tables, pictures."""

import functools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from experiments.parallel import num_compilers, num_cores
from experiments.report import Table
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots
from experiments.words import joined, percent, quantity
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

_One = TypeVar("_One", Point, Estimate)


class Choice(NamedTuple):
    """What to take for a gradient: the way, the samples that it needs, and the time that one estimate then takes (s)."""

    estimate: Estimate
    num_samples: float
    seconds: float


def lines(measured: Iterable[_One]) -> dict[tuple[Any, ...], list[_One]]:
    """Gather what differs in time step, or in the number of samples, alone."""
    found: dict[tuple[Any, ...], list[_One]] = {}
    for one in measured:
        found.setdefault(one.line, []).append(one)
    return found


def fastest(points: Iterable[Point], target: float) -> Point | None:
    """Give the fastest point from which on its line stays below an error; None if there is none.

    One coarse point that is right by luck, between finer ones that are not, does not count.
    """
    found = []
    for line in lines(points).values():
        for point in sorted(line, key=lambda one: one.knobs.timestep):
            if not point.error <= target:
                break
            found.append(point)
    return min(found, key=lambda one: one.cost, default=None)


def samples_for(one: Estimate, target: float) -> float:
    """Give how many samples bring the error to a target, were bias and variance per sample to stay; or infinity."""
    room = target**2 - one.bias**2
    return max(2.0, np.ceil(one.variance * one.num_samples / room)) if room > 0 else np.inf


def cheapest(estimates: Iterable[Estimate], target: float) -> Choice | None:
    """Give the estimate that reaches an error in the least time, its samples made as many as that takes; or None.

    Of those that differ in the number of samples alone the largest speaks, for it knows its bias best.
    """
    choices = []
    for line in lines(estimates).values():
        one = max(line, key=lambda each: each.num_samples)
        count = samples_for(one, target)
        # A bias is not known better than this: what chance could hide of it has to fit as well.
        if np.isfinite(count) and one.bias_error <= target:
            choices.append(Choice(one, count, one.cost * count / one.num_samples))
    return min(choices, key=lambda one: one.seconds, default=None)


def answer(outcome: Outcome) -> str:
    """Give the price of an error of the motion, and what gets a gradient to it soonest."""
    target = max(outcome.settings.targets)
    best = [one for course in outcome.courses if (one := _best(course, MG, target)) is not None]
    ways = Counter(
        one.estimate.estimator for course in outcome.courses if (one := cheapest(course.estimates, target)) is not None
    )
    if not best:
        return f"No setting is known to reach {percent(target)} of the motion."
    costs = sorted(one.cost for one in best)
    span = "–".join(dict.fromkeys(map(_milliseconds, (costs[0], costs[-1]))))
    count = len(outcome.courses)
    where = "a simulated second" if len(best) == count else f"a second on {len(best)} of {count} scenes"
    motion = f"{percent(target)} error: {span} ms {where}"
    soonest = [name for name, times in ways.items() if times == max(ways.values())]
    if not soonest:
        return f"{motion}."
    return f"{motion}; gradients: {soonest[0] if len(soonest) == 1 else f'{len(soonest)} ways tie'}."


def verdict(outcome: Outcome) -> str:
    """Say how the libraries stand at the largest target, over all scenes."""
    target = max(outcome.settings.targets)
    times = []
    for other, name in ((MJX, "mjx.step"), (C, f"C MuJoCo on {_threads()}")):
        pairs = [(_best(course, MG, target), _best(course, other, target)) for course in outcome.courses]
        if ratios := [one.cost / two.cost for one, two in pairs if one is not None and two is not None]:
            reach = f" ({min(ratios):.2g} to {max(ratios):.2g} on {len(ratios)} scenes)" if len(ratios) > 1 else ""
            times.append(f"{np.median(ratios):.2g} times as long as {name}{reach}")
    found = [cheapest(course.estimates, target) for course in outcome.courses]
    counts = Counter(choice.estimate.estimator for choice in found if choice is not None)
    ways = [f"{name} (on {count} {'scene' if count == 1 else 'scenes'})" for name, count in counts.most_common()]
    lost = found.count(None)
    sentences = []
    if times:
        sentences.append(f"For {percent(target)} error of the motion mg.step takes {joined(times)}.")
    if times and (beyond := sum(_best(course, MG, target) is None for course in outcome.courses)):
        sentences.append(f"On {beyond} of {len(found)} scenes no setting of it is known to get there.")
    if ways:
        sentences.append(f"{percent(target)} error of the gradient is soonest reached by {'; '.join(ways)}.")
    if lost and sentences:
        sentences.append(f"On {lost} of {len(found)} scenes no way of estimating it is known to get there.")
    return " ".join(sentences) or "No setting reached a target on any scene."


def findings(outcome: Outcome) -> list[str]:
    """Say what an onset makes of the error, and what is not known."""
    sentences = []
    if ratios := {course.title: found for course in outcome.courses if (found := _onset_ratios(course))}:
        every = np.concatenate([*ratios.values()])
        medians = ", ".join(f"{np.median(found):.2g} ({title})" for title, found in ratios.items())
        sentences.append(
            f"With contact that begins within the step the error of the motion, at the same integrator and time step, is "
            f"{medians} times the step's in the median, and larger by more than a tenth at {(every > 1.1).sum()} of "
            f"{every.size} time steps."
        )
    own = {course.title: course.references[MG, course.cone] for course in outcome.courses}
    untold = {
        "Halving the step did not bring the reference nearer, so that the dotted line is all that is known": [
            course.title for course in outcome.courses if not all(one.converges for one in course.references.values())
        ],
        "MJX makes other contacts than C MuJoCo, so that each has its own reference": [
            title for title, one in own.items() if one.distance_to_c > max(1e-5, 3 * one.error)
        ],
        "The two ways to the reference gradient differ beyond chance, which makes its errors doubtful": [
            course.title for course in outcome.courses if not course.gradient_reference.agrees
        ],
    }
    return sentences + [f"{what}: {'; '.join(titles)}." for what, titles in untold.items() if titles]


def _onset_ratios(course: Course) -> list[float]:
    """Give the error of the motion with an onset over that without, step by step, where the reference can tell."""
    tight = {
        (p.library, p.knobs.timestep): p.error
        for p in course.in_batch()
        if (p.variant.integrator, p.variant.precision, p.variant.iterations) == ("Euler", "float64", NUM_ITERATIONS)
        and p.knobs.tolerance <= 1e-7
    }
    pairs = [(error, tight[MG, timestep]) for (library, timestep), error in tight.items() if library == ONSET]
    floor = 3 * course.floor(MG)
    return [one / plain for one, plain in pairs if np.isfinite(one) and np.isfinite(plain) and plain > floor]


def summary(outcome: Outcome) -> Table:
    """Tabulate what to take for which error, scene by scene."""
    targets = sorted(outcome.settings.targets, reverse=True)
    columns = ["scene", "reference known to"]
    for share in map(percent, targets):
        columns += [f"motion to {share}", "ms per s; mjx.step; C MuJoCo", f"gradient to {share}"]
    rows = []
    for course in outcome.courses:
        row = [course.title, _share(course.floor(MG))]
        for target in targets:
            best = [_best(course, name, target) for name in (MG, MJX, C)]
            nothing = "?" if course.floor(MG) > target else "–"
            costs = "; ".join("–" if one is None else _milliseconds(one.cost) for one in best)
            row += [nothing if best[0] is None else _way(best[0]), costs, _choice(cheapest(course.estimates, target))]
        rows.append(row)
    caption = (
        "What reaches an error in the least time: of the motion by mg.step, with milliseconds per simulated second of one "
        f"state in a batch of {outcome.settings.sizes.batch}, beside the fastest of mjx.step and of C MuJoCo on "
        f"{_threads()}; of the gradient, with its rollouts, as many as bias and variance call for, and their time. A dash: "
        "no setting gets there; a question mark: the reference is not known so well."
    )
    return Table(columns, rows, caption)


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate time for one state and for a batch, compilation, and what cone and contact model make of the motion."""
    rows = []
    for course in outcome.courses:
        euler = [one for one in course.points if one.variant.integrator == "Euler"]
        compiling = [np.median([one.compile_seconds for one in euler if one.library == name]) for name in (MG, MJX)]
        others = [one for (engine, cone), one in course.references.items() if engine == MG and cone != course.cone]
        found = course.gradient_reference
        row = [course.title, *(_alone_and_together(course, name) for name in (MG, MJX, C))]
        row += [f"{seconds:.1f}" for seconds in compiling]
        row += [_share(others[0].distance) if others else "–", _share(course.references[MG, course.cone].distance_to_c)]
        rows.append([*row, "; ".join(map(_share, (found.standard_error, found.step_error, found.difference)))])
    columns = (
        "scene", "mg.step: alone; in batch", "mjx.step: alone; in batch", "C MuJoCo: alone; in batch",
        "to compile mg.step, s", "mjx.step, s", "cone changes the motion by", "MJX from C MuJoCo",
        "reference gradient: chance; step; other way",
    )  # fmt: skip
    caption = (
        "Milliseconds per simulated second of one state at the scene's own time step (Euler; MJX in float32), simulated "
        f"alone and in a batch of {outcome.settings.sizes.batch} (C MuJoCo on one thread and on {_threads()}); a dash: not "
        f"tried. Seconds to trace and compile one program, {num_compilers()} at a time. How far the other cone's motion "
        "ends, and MJX's from C MuJoCo's. The reference gradient: standard error, change with the last halving of the step, "
        "distance to the same gradient by differences of smoothed outcomes."
    )
    return [Table(columns, rows, caption)]


def _alone_and_together(course: Course, library: str) -> str:
    """Give milliseconds per simulated second of a state at the scene's own step."""
    costs: dict[bool, float] = {}
    for one in course.points:
        variant, knobs = one.variant, one.knobs
        is_plain = (variant.integrator, variant.cone, knobs.timestep) == ("Euler", course.cone, course.timestep)
        is_converged = variant.iterations >= NUM_ITERATIONS and knobs.tolerance <= 1e-6
        if one.library == library and is_plain and is_converged and (library == C or variant.precision == "float32"):
            costs[variant.batch > 1] = 1e3 * one.cost
    return "; ".join(f"{costs[together]:.3g}" if together in costs else "–" for together in (False, True))


def _best(course: Course, library: str, target: float) -> Point | None:
    """Give the fastest way of a library, unless the reference is not known that well."""
    if course.floor(library) > target:
        return None
    return fastest((point for point in course.in_batch() if point.library == library), target)


def _way(point: Point) -> str:
    tolerance = f", tolerance {point.knobs.tolerance:g}" if point.knobs.tolerance > 1e-6 else ""
    return f"{point.variant.integrator}, {point.variant.precision}, {1e3 * point.knobs.timestep:g} ms{tolerance}"


def _choice(choice: Choice | None) -> str:
    if choice is None:
        return "–"
    one = choice.estimate
    soft = f", contact {one.softening:g} times softer" if one.softening != 1 else ""
    count = f"{choice.num_samples:.0f}" if choice.num_samples < 1e4 else quantity(choice.num_samples)
    seconds = f"{_milliseconds(choice.seconds)} ms" if choice.seconds < 10 else f"{choice.seconds:.0f} s"
    return f"{one.estimator}, {1e3 * one.timestep:g} ms{soft}, {count} rollouts, {seconds}"


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.2g}" if seconds < 1e-2 else f"{1e3 * seconds:.0f}"


def _threads() -> str:
    return f"{num_cores()} threads" if num_cores() > 1 else "one thread"


def _share(share: float) -> str:
    """Write what smooth motions in double precision bring close to rounding."""
    if not np.isfinite(share):
        return "not finite"
    return "< 0.001%" if 0 < share < 1e-5 else percent(share)


_COLOURS = {MG: ZEROTH, ONSET: "#cc79a7", MJX: FIRST, C: "#009e73"}
_ESTIMATORS = {
    "zeroth order": ZEROTH,
    "first order, discrete": FIRST,
    "first order, slope": "#e69f00",
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
    _frontier(axes[0, 0], [(one.cost, max(one.error, _SMALLEST)) for one in tight])
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
    caption = (
        f"Error of the final state, root mean square over {outcome.settings.sizes.batch} starts in one batch, against wall "
        "time: the larger of the distance of positions (m and rad, Euclidean) over the way gone and that of velocities over "
        "the speed. Along a line the time step gets smaller to the right; bars are the range over repetitions. Left: the "
        f"solver run to {TIGHT_TOLERANCE:g} (float32: {SINGLE_TOLERANCE:g}), the scene's own cone; no other beats the broad "
        "grey line. Right: loose tolerances at the two coarsest steps, few iterations, and the other "
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
        _frontier(axis, [(getattr(one, cost), one.error) for one in estimates])
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
    axes[0].xaxis.set_minor_formatter(NullFormatter())
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


def _frontier(axis: Axes, places: list[tuple[float, float]]) -> None:
    """Draw the points on the front in order of cost; none if all has diverged."""
    points = np.array(places).reshape(-1, 2)
    front = np.array(sorted(map(tuple, points[pareto_front(*points.T)]))).reshape(-1, 2)
    axis.step(*front.T, where="post", color=REFERENCE, lw=4.5, alpha=0.13, zorder=0)


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
