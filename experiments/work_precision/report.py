"""The answer in words, computed from the numbers."""

import numpy as np

from experiments.parallel import num_compilers
from experiments.report import Table
from experiments.words import quantity
from experiments.work_precision.choice import Choice, cheapest, fastest
from experiments.work_precision.outcome import MG, MJX, NUM_ITERATIONS, ONSET, C, Course, Outcome, Point


def verdict(outcome: Outcome) -> str:
    """Say how the libraries stand at the largest target, over all scenes."""
    target = max(outcome.settings.targets)
    sentences = []
    for other, name in ((MJX, "mjx.step"), (C, f"C MuJoCo on {_threads(outcome)}")):
        ratios = _ratios(outcome, other, target)
        if ratios:
            sentences.append(
                f"For {_percent(target)} error of the motion mg.step takes {np.median(ratios):.2g} times the time of {name} "
                f"{_over(ratios, outcome)}."
            )
    chosen = [cheapest(course.estimates, target) for course in outcome.courses]
    names = [choice.estimate.estimator for choice in chosen if choice is not None]
    if names:
        counts = {name: names.count(name) for name in dict.fromkeys(names)}
        ranked = sorted(counts.items(), key=lambda item: -item[1])
        listed = "; ".join(f"{name} (on {count} {'scene' if count == 1 else 'scenes'})" for name, count in ranked)
        sentences.append(f"{_percent(target)} error of the gradient is soonest reached by {listed}.")
    lost = len(outcome.courses) - len(names)
    if lost:
        sentences.append(f"On {lost} of {len(outcome.courses)} scenes no way of estimating it is known to get there.")
    return " ".join(sentences) or "No setting reached a target on any scene."


def findings(outcome: Outcome) -> list[str]:
    """Say what an onset makes of the error, and what is not known."""
    sentences = _onset_against_step(outcome)
    loose = [course.title for course in outcome.courses if not all(one.converges for one in course.references)]
    if loose:
        sentences.append(
            "Halving the step did not bring the reference nearer, so that the dotted line is all that is known: "
            f"{'; '.join(loose)}."
        )
    apart = [(c.title, c.reference(MG, c.cone)) for c in outcome.courses]
    apart = [(title, one) for title, one in apart if one.distance_to_c > max(1e-5, 3 * one.error)]
    if apart:
        listed = "; ".join(f"{title}, {_percent(one.distance_to_c)} apart" for title, one in apart)
        sentences.append(f"MJX makes other contacts than C MuJoCo, so that each has its own reference: {listed}.")
    doubtful = [course.title for course in outcome.courses if not course.gradient_reference.agrees]
    if doubtful:
        sentences.append(
            "The two ways to the reference gradient differ beyond chance, which makes its errors doubtful: "
            f"{'; '.join(doubtful)}."
        )
    return sentences


def _onset_against_step(outcome: Outcome) -> list[str]:
    """Say what contact that begins within the step makes of the error; nothing if it was nowhere tried."""
    ratios = {course.title: found for course in outcome.courses if (found := _onset_ratios(course))}
    if not ratios:
        return []
    every = np.concatenate([*ratios.values()])
    listed = ", ".join(f"{np.median(found):.2g} ({title})" for title, found in ratios.items())
    return [
        f"With contact that begins within the step the error of the motion, at the same integrator and time step, is {listed} "
        f"times the step's in the median, and larger by more than a tenth at {(every > 1.1).sum()} of {every.size} time steps."
    ]


def _onset_ratios(course: Course) -> list[float]:
    """Give the error of the motion with an onset over that without, step by step, where the reference can tell."""
    tight = {
        (p.library, p.timestep): p.error
        for p in course.in_batch()
        if p.integrator == "Euler"
        and p.precision == "float64"
        and p.iterations == NUM_ITERATIONS
        and p.tolerance <= 1e-7
    }
    plain = {timestep: error for (library, timestep), error in tight.items() if library == MG}
    found = {timestep: error for (library, timestep), error in tight.items() if library == ONSET}
    floor = course.floor(MG)
    return [
        found[h] / plain[h] for h in found if np.isfinite(found[h]) and np.isfinite(plain[h]) and plain[h] > 3 * floor
    ]


def summary(outcome: Outcome) -> Table:
    """Tabulate what to take for which error, scene by scene."""
    targets = sorted(outcome.settings.targets, reverse=True)
    columns = ["scene", "reference known to"]
    for percent in map(_percent, targets):
        columns += [f"motion to {percent}", "ms per s; mjx.step; C MuJoCo", f"gradient to {percent}"]
    rows = []
    for course in outcome.courses:
        row = [course.title, _percent(course.floor(MG))]
        for target in targets:
            best = {name: _best(course, name, target) for name in (MG, MJX, C)}
            costs = "; ".join(_milliseconds(best[name]) for name in (MG, MJX, C))
            row += [_way(best[MG], course, target), costs, _choice(cheapest(course.estimates, target))]
        rows.append(row)
    caption = (
        "What reaches an error in the least time: of the motion by mg.step, with milliseconds per simulated second of one "
        f"state in a batch of {outcome.settings.sizes.batch}, and the same for the fastest ways of mjx.step and of C MuJoCo on "
        f"{_threads(outcome)}; of the gradient with its rollouts, as many as bias and variance call for, and the time they "
        "take. A dash: no setting that was tried gets there; a question mark: the reference is not known so well."
    )
    return Table(columns, rows, caption)


def batches(outcome: Outcome) -> Table:
    """Tabulate time for one state and for a batch, compilation, and what cone and contact model make of the motion."""
    rows = []
    for course in outcome.courses:
        row = [course.title, *(_alone_and_together(course, name) for name in (MG, MJX, C))]
        for library in (MG, MJX):
            seconds = [p.compile_seconds for p in course.points if p.library == library and p.integrator == "Euler"]
            row.append(f"{np.median(seconds):.1f}")
        others = [one for one in course.references if one.cone != course.cone and one.engine == MG]
        row.append(_percent(others[0].distance) if others else "–")
        row.append(_percent(course.reference(MG, course.cone).distance_to_c))
        found = course.gradient_reference
        row.append(f"{_percent(found.standard_error)}; {_percent(found.step_error)}; {_percent(found.difference)}")
        rows.append(row)
    columns = (
        "scene", "mg.step: alone; in batch", "mjx.step: alone; in batch", "C MuJoCo: alone; in batch",
        "to compile mg.step, s", "mjx.step, s", "cone changes the motion by", "MJX from C MuJoCo",
        "reference gradient: chance; step; other way",
    )  # fmt: skip
    caption = (
        "Milliseconds per simulated second of one state at the scene's own time step (Euler; MJX in float32), simulated alone "
        f"and in a batch of {outcome.settings.sizes.batch} (C MuJoCo on one thread and on {_threads(outcome)}). A "
        "dash: not tried on this scene. The figures are about batches, which MJX is made for, and so are estimators. "
        f"Seconds to trace and compile one program, {num_compilers()} at a time. Then how far the other cone's motion ends, "
        "and MJX's from C MuJoCo's; last what is known of the reference gradient: standard error, change with the last "
        "halving of the step, distance to the same gradient by differences of smoothed outcomes."
    )
    return Table(columns, rows, caption)


def _alone_and_together(course: Course, library: str) -> str:
    """Give milliseconds per simulated second of a state at the scene's own step."""
    costs: dict[bool, float] = {}
    for one in course.points:
        is_plain = one.integrator == "Euler" and one.cone == course.cone and one.timestep == course.timestep
        is_converged = one.iterations >= NUM_ITERATIONS and one.tolerance <= 1e-6
        if one.library == library and is_plain and is_converged and (library == C or one.precision == "float32"):
            costs[one.batch > 1] = 1e3 * one.cost
    return "; ".join(f"{costs[together]:.3g}" if together in costs else "–" for together in (False, True))


def _best(course: Course, library: str, target: float) -> Point | None:
    """Give the fastest way of a library, unless the reference is not known that well."""
    if course.floor(library) > target:
        return None
    return fastest((point for point in course.in_batch() if point.library == library), target)


def _ratios(outcome: Outcome, other: str, target: float) -> list[float]:
    pairs = [(_best(course, MG, target), _best(course, other, target)) for course in outcome.courses]
    return [one.cost / two.cost for one, two in pairs if one is not None and two is not None]


def _way(point: Point | None, course: Course, target: float) -> str:
    if point is None:
        return "?" if course.floor(MG) > target else "–"
    return _setting(point)


def _setting(point: Point) -> str:
    tolerance = f", tolerance {point.tolerance:g}" if point.tolerance > 1e-6 else ""
    return f"{point.integrator}, {point.precision}, {1e3 * point.timestep:g} ms{tolerance}"


def _choice(choice: Choice | None) -> str:
    if choice is None:
        return "–"
    one = choice.estimate
    soft = f", contact {one.softening:g} times softer" if one.softening != 1 else ""
    count = f"{choice.num_samples:.0f}" if choice.num_samples < 1e4 else quantity(choice.num_samples)
    seconds = f"{_milliseconds_of(choice.seconds)} ms" if choice.seconds < 10 else f"{choice.seconds:.0f} s"
    return f"{one.estimator}, {1e3 * one.timestep:g} ms{soft}, {count} rollouts, {seconds}"


def _milliseconds(point: Point | None) -> str:
    return "–" if point is None else _milliseconds_of(point.cost)


def _milliseconds_of(seconds: float) -> str:
    return f"{1e3 * seconds:.2g}" if seconds < 1e-2 else f"{1e3 * seconds:.0f}"


def _over(ratios: list[float], outcome: Outcome) -> str:
    if len(ratios) == 1:
        return "on the one scene where both reach it" if len(outcome.courses) > 1 else "on this scene"
    return f"in the median of {len(ratios)} scenes ({min(ratios):.2g} to {max(ratios):.2g} times)"


def _threads(outcome: Outcome) -> str:
    count = outcome.settings.num_threads
    return f"{count} threads" if count > 1 else "one thread"


def _percent(share: float) -> str:
    if not np.isfinite(share):
        return "not finite"
    if share == 0 or share >= 1e-5:
        return f"{100 * share:.2g} %"
    return f"{100 * share:.0e} %".replace("e-0", "e-").replace("-", "−")
