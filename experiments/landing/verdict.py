"""The answer of an experiment on impacts in words, computed from its numbers."""

import numpy as np

from experiments.landing.outcome import DISCRETE, EVENT, Course, Outcome
from experiments.report import Table


def verdict(outcome: Outcome) -> str:
    """Say where the event gradient is the slope.

    Args:
        outcome: the numbers.

    Returns:
        A few sentences.
    """
    event, discrete = _total(outcome, EVENT), _total(outcome, DISCRETE)
    if not event[2]:
        return "No slope is known well enough to judge a derivative by: take more rollouts, or a shorter motion."
    percent = f"{outcome.settings.tolerance:.0%}"
    sentences = [
        f"After the first impact the event gradient is within {percent} at {event[0]} of {event[2]} times and coordinates, "
        f"the discrete one at {discrete[0]}."
    ]
    failing = [course for course in outcome.all if course.share(EVENT)[1]]
    listed = [f"{_name(c)} ({c.share(EVENT)[1]} of {c.share(EVENT)[2]})" for c in failing]
    off = (
        f"It is farther off beyond chance in {_join(listed)}" if failing else "Nowhere is it farther off beyond chance"
    )
    untold = event[2] - event[0] - event[1]
    rest = f"; at {untold} it cannot be told from so few rollouts." if untold else "."
    return " ".join([*sentences, off + rest])


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each.

    Args:
        outcome: the numbers.

    Returns:
        One for each motion at its own time step, and what cannot be judged.
    """
    sentences = []
    for course in outcome.all:
        found, judged = course.found, course.can_judge & course.has_impact
        if not judged.any():
            continue
        row = found.gradients.index(DISCRETE)
        ratio = np.where(judged, np.abs(found.error[row]), -1)
        i, j = np.unravel_index(np.argmax(ratio), ratio.shape)
        values = found.slope[i, j], *(found.mean[found.gradients.index(name), i, j] for name in (DISCRETE, EVENT))
        slope, discrete, event = (f"{value:.3g}".replace("-", "−") for value in values)
        sentences.append(
            f"{_name(course)}: the discrete gradient is farthest off at {course.times[i]:.2f} s, {course.labels[j]}: "
            f"{discrete} where the slope is {slope}; the event gradient says {event}."
        )
    lost = [course for course in outcome.all if not (course.can_judge | ~course.has_impact).all()]
    if lost:
        parts = [f"{_name(c)} ({int((~c.can_judge & c.has_impact).sum())} of {c.has_impact.sum()})" for c in lost]
        sentences.append(
            f"Where the slope is too uncertain, by chaos or too few rollouts, nothing is judged: {_join(parts)}."
        )
    heavy = [course for course in outcome.all if (course.is_heavy & course.can_judge & course.has_impact).any()]
    if heavy:
        parts = [
            f"{_name(c)} ({(c.is_heavy & c.can_judge & c.has_impact).sum()} of {c.share(EVENT)[2]})" for c in heavy
        ]
        sentences.append(
            "A hundredth of the starts carries half of the event gradient's variance or more, so that its mean and error bar "
            f"are doubtful, in {_join(parts)}."
        )
    return sentences


def table(outcome: Outcome) -> Table:
    """Tabulate the errors of both derivatives by motion and time step."""
    rows, emphasised = [], set()
    for course in outcome.all:
        if course.share(EVENT)[1]:
            emphasised.add((len(rows), 6))
        rows.append(
            [
                course.title,
                f"{1e3 * course.timestep:g}",
                f"{len(course.events)}",
                *(_errors(course, name) for name in (DISCRETE, EVENT)),
                _bar(course),
                *(_counts(course, name) for name in (EVENT, DISCRETE)),
            ]
        )
    percent = f"{outcome.settings.tolerance:.0%}"
    return Table(
        (
            "motion", "time step, ms", "contacts and limits that begin", "error, discrete", "error, event",
            "standard error, event", f"event within {percent}", f"discrete within {percent}",
        ),
        rows,
        "Errors as a share of the larger of the slope and the discrete gradient's own error, after the first impact: median "
        "and largest over times and coordinates; the standard error in the same measure and way. Counts are of those where the "
        "slope can be judged by; bold where the event gradient is somewhere beyond the tolerance by more than two standard "
        "errors.",
        frozenset(emphasised),
    )  # fmt: skip


def _total(outcome: Outcome, gradient: str) -> tuple[int, ...]:
    return tuple(np.sum([course.share(gradient) for course in outcome.all], axis=0).tolist())


def _counts(course: Course, gradient: str) -> str:
    close, _, judged = course.share(gradient)
    return f"{close} of {judged}"


def _errors(course: Course, gradient: str) -> str:
    if not course.share(gradient)[2]:
        return "not judged"
    return f"{course.median(gradient):.1%}, {course.worst(gradient):.1%}"


def _bar(course: Course) -> str:
    judged = course.can_judge & course.has_impact
    if not judged.any():
        return "not judged"
    bars = (course.found.standard_error / course.found.scale)[course.found.gradients.index(EVENT)][judged]
    return f"{np.median(bars):.1%}, {bars.max():.1%}"


def _name(course: Course) -> str:
    return f"{course.title} at {1e3 * course.timestep:g} ms"


def _join(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
