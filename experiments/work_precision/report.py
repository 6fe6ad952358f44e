"""The answer in words, computed from the numbers."""

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from experiments.parallel import num_compilers, num_cores
from experiments.report import Table
from experiments.words import joined, percent, quantity
from experiments.work_precision.outcome import MG, MJX, NUM_ITERATIONS, ONSET, C, Course, Estimate, Outcome, Point

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
