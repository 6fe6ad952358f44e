"""The answer of the experiment on the thrown cube in words, computed from its numbers."""

import numpy as np

from experiments.cube_toss.measure import CONTACTS, METHODS, PUBLISHED_DERIVATIVE, Course, Outcome, Point
from experiments.report import Table
from experiments.words import joined, percent, quantity

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
