"""The answer of the experiment on the thrown cube in words, computed from its numbers."""

import numpy as np

from experiments.cube_toss.outcome import METHODS, Course, Outcome, Point
from experiments.cube_toss.throw import PUBLISHED_DERIVATIVE
from experiments.report import Table
from experiments.words import quantity

_CONTACTS = {"published": "With a contact that begins continuously", "default": "With MuJoCo's default contact"}


def verdict(outcome: Outcome) -> str:
    """Say what reaches the wanted error soonest, and what never does."""
    return " ".join(_verdict(course, outcome.settings.target_error) for course in outcome.courses)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    found = [sentence for course in outcome.courses for sentence in (_event(course), _choice(course)) if sentence]
    published = [course for course in outcome.courses if course.contact == "published"]
    if published:
        found.append(
            f"DiffMJX published the derivative {PUBLISHED_DERIVATIVE:g} for these measures, and 1.9 % error in 9.2 s after 67 s "
            f"of compilation; here it is {quantity(published[0].scale)} (C MuJoCo's steps of 10 µs give 0.571). That simulator "
            "softens collisions and lets contacts act from a distance, and ran on other hardware: its times stand beside "
            "ours, not for the same problem."
        )
    slowest = {
        method: max(p.first_seconds for c in outcome.courses for p in c.of(method))
        for method in METHODS
        if any(c.of(method) for c in outcome.courses)
    }
    listed = ", ".join(f"{METHODS[method]} {seconds:.0f} s" for method, seconds in slowest.items())
    found.append(
        f"Longest first call, compilation and all throws included (less where the compilation was cached): {listed}."
    )
    return found


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all points."""
    rows, emphasised = [], set()
    for course in outcome.courses:
        fastest = course.fastest(outcome.settings.target_error)
        for point in course.points:
            if point is fastest:
                emphasised.add((len(rows), 3))
            rows.append(
                [
                    course.contact,
                    METHODS[point.method],
                    f"{point.setting:g}",
                    _percent(course.error(point)),
                    _percent(course.bias(point)),
                    f"{point.seconds:.3g}",
                    f"{point.num_steps:.0f}",
                ]
            )
    columns = ("contact", "method", "time step (s) or tolerance", "error", "bias", "processor time, s", "steps")
    caption = (
        "Error: root mean square over throws, of a single derivative, as a share of the derivative; bias: its mean. "
        "Reference: difference quotient of adaptive rollouts at tolerance 1e-10. Short steps at events are not counted. In bold "
        f"the fastest whose method stays below {outcome.settings.target_error:.0%} from there on."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _verdict(course: Course, target: float) -> str:
    start, fastest = _CONTACTS[course.contact], course.fastest(target)
    best = {method: min((course.error(p) for p in course.of(method)), default=np.inf) for method in METHODS}
    never = [METHODS[method] for method in ("discrete", "adaptive") if best[method] > max(0.2, target)]
    if fastest is None:
        closest = min(best, key=lambda method: best[method])
        head = (
            f"{start} nothing stays below {target:.0%}; the closest is {METHODS[closest]} ({_percent(best[closest])})"
        )
    else:
        head = (
            f"{start} the first below {target:.0%} is {METHODS[fastest.method]} ({_setting(fastest)}): "
            f"{_percent(course.error(fastest))} in {fastest.seconds:.2g} s of processor time"
        )
    if not never:
        return f"{head}."
    return f"{head}; {' and '.join(never)} {'stays' if len(never) == 1 else 'stay'} above 20 % at every setting."


def _event(course: Course) -> str | None:
    discrete, event = (sorted(course.of(name), key=lambda p: p.setting) for name in ("discrete", "event"))
    if not discrete or not event:
        return None
    pairs = ", ".join(
        f"{_percent(course.error(a))} and {_percent(course.error(b))} at {a.setting:g} s"
        for a, b in zip(discrete, event, strict=True)
    )
    return f"{_CONTACTS[course.contact]} a discrete and an event-corrected derivative are off by {pairs}."


def _choice(course: Course) -> str | None:
    """Compare the onset and short steps with an event gradient of the same price."""
    sentences = []
    for method in ("continuous", "substeps"):
        for point in course.of(method):
            same = [p for p in course.of("event") if p.seconds <= point.seconds]
            if not same:
                continue
            rival = min(same, key=course.error)
            is_better = course.error(point) < course.error(rival)
            sentences.append((point, is_better))
    if not sentences:
        return None
    won = [point for point, is_better in sentences if is_better]
    total = len(sentences)
    names = ", ".join(f"{METHODS[p.method]} at {p.setting:g} s" for p in won)
    tail = f" ({names})" if won else ""
    return (
        f"{_CONTACTS[course.contact]} contact that begins within the step or short steps at events beat an event gradient that "
        f"takes no longer in {len(won)} of {total} settings{tail}."
    )


def _setting(point: Point) -> str:
    kind = "tolerance" if point.method in ("adaptive", "quotient") else "time step"
    return f"{kind} {point.setting:g}{'' if kind == 'tolerance' else ' s'}"


def _percent(share: float) -> str:
    if not np.isfinite(share):
        return "failed"
    return f"{100 * share:.2g} %".replace("-", "−") if abs(share) < 1 else f"{share:.3g}×".replace("-", "−")
