"""The answer of an experiment on artificial discontinuities in words, computed from its numbers."""

import numpy as np

from experiments.artificial_discontinuity.outcome import WAYS, Outcome, largest, worst
from experiments.report import Table
from experiments.words import joined, percent, quantity

# Standard errors from which a bias is beyond chance, of some dozens of estimates.
_FAR = 4.0
_SMALL = 1e-4


def verdict(outcome: Outcome) -> str:
    """Say which bodies jump, and what to build contact of."""
    threshold = outcome.settings.threshold
    bodies = [name for name in outcome.shapes if not outcome.of(name)[0].is_lattice]
    most = {name: max(one.geometric for one in outcome.of(name)) for name in bodies}
    plain = {name: max(one.worst for one in outcome.of(name)) for name in bodies}
    smooth = [name for name in bodies if most[name] <= threshold]
    rough = [f"{name} ({most[name]:.0%})" for name in bodies if most[name] > threshold]
    sentences = []
    if rough:
        sentences.append(f"By its geometry alone the force jumps by more than {threshold:.0%} with {joined(rough)}.")
    if smooth:
        rows = [f"{name} ({_counted(outcome.of(name)[0].num_rows, 'row')})" for name in smooth]
        sentences.append(f"It does not with {joined(rows)}: to differentiate through contact build it of these.")
        if worse := [f"{name} ({plain[name]:.0%})" for name in smooth if plain[name] > threshold]:
            sentences.append(
                f"Under MuJoCo's default contact, whose force begins with a jump, it still does with {joined(worse)} where "
                "one more part touches: there let the impedance rise from zero (the first number of solimp)."
            )
    else:
        sentences.append(f"None of the bodies is without; the least has {min(bodies, key=lambda name: most[name])}.")
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    return [
        sentence
        for sentence in (
            _lattices(outcome),
            _biases(outcome),
            _same_in_c(outcome),
            _friction(outcome),
        )
        if sentence
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate jumps by body and path, the box's jumps one by one, the estimates across them, and the peg and the hole."""
    return [_by_body(outcome), _by_jump(outcome), _by_estimate(outcome), _by_mating(outcome)]


def _lattices(outcome: Outcome) -> str:
    parts = []
    for name, path in outcome.paths.items():
        power, error = outcome.rate(name)
        if np.isfinite(power):
            parts.append(f"{path.title} {quantity(power, error)}")
    if not parts:
        return ""
    return (
        f"With ever more points the largest jump of a pressure field's stand-in falls as a power of their number along an edge: "
        f"{joined(parts)}."
    )


def _biases(outcome: Outcome) -> str:
    jumping = [one for one in outcome.slopes if abs(one.jump) > abs(one.bias[0]) / 2 and one.deviation[0] > _FAR]
    if not jumping:
        return ""
    rest = [abs(one.bias[0] + one.jump) / abs(one.bias[0]) for one in jumping]
    return (
        f"Where the push itself jumps ({len(jumping)} of {len(outcome.slopes)}), the jump times the density of the noise is the "
        f"discrete gradient's bias, up to {np.median(rest):.0%} of it in the median."
    )


def _same_in_c(outcome: Outcome) -> str:
    own = [one for one in outcome.statics if len(one.plain.places) > len(one.c_mujoco.places)]
    if not own:
        return ""
    copies = sum(bool(one.copies.max()) for one in own)
    return (
        f"MJX has jumps that C has not at {len(own)} of {len(outcome.statics)} bodies and paths, some of them small; at {copies} "
        "of these it repeats contact points to fill their number, which weighs some corners twice or three times."
    )


def _friction(outcome: Outcome) -> str:
    jumps = outcome.friction
    kind = f"jumps by {worst(jumps):.0%} at standstill" if len(jumps.places) else "has no jump left"
    width = 2 * jumps.scale / jumps.steepest if jumps.steepest else np.nan
    return (
        f"Stick or slip, which is real, is no jump here: friction against sliding speed {kind}; the soft constraint turns it "
        f"over {quantity(1e3 * width)} mm/s."
    )


def _by_body(outcome: Outcome) -> Table:
    rows, emphasised = [], set()
    for name in outcome.shapes:
        statics = outcome.of(name)
        cells = []
        for i, one in enumerate(statics):
            others = [one.gentle, one.smoothed, one.c_mujoco]
            cells.append(
                ", ".join([_percent(one.worst), *(_percent(worst(other)) for other in others if other is not None)])
            )
            if one.worst > outcome.settings.threshold:
                emphasised.add((len(rows), 2 + i))
        rows.append([name, str(statics[0].num_rows), *cells])
    return Table(
        ("body", "rows", *(path.title for path in outcome.paths.values())),
        rows,
        "Largest jump over the largest force on the path: under MuJoCo's default contact, under one that begins gently, under "
        "the default one smoothed, and in C MuJoCo; lattices have a contact of their own, in mjxgrad and in C. In bold beyond "
        "the threshold.",
        frozenset(emphasised),
    )


def _by_jump(outcome: Outcome) -> Table:
    rows = [
        [
            outcome.paths[one.path].title,
            f"{one.place:.4f} {outcome.paths[one.path].unit}".replace("-", "−"),
            f"{one.from_contacts} → {one.to_contacts}",
            _percent(one.relative),
            _percent(one.reference_jump),
            _percent(one.reference_change),
            one.kind,
        ]
        for one in outcome.judged
        if one.relative > outcome.settings.threshold
    ]
    return Table(
        ("path", "at", "contacts", "jump over force", "reference jumps by", "changes nearby by", "which is"),
        rows,
        f"The jumps of the box beyond {outcome.settings.threshold:.0%} of the force beside them, of {len(outcome.judged)} in "
        "all. The reference is the gradient of the overlap volume; nearby is one penetration depth to each side. A jump of "
        "which it does at least half at once is real; at least half nearby: a real change, made sudden. The onset of a "
        "contact is no jump where contact begins gently.",
    )


def _by_estimate(outcome: Outcome) -> Table:
    rows, emphasised = [], set()
    for one in outcome.slopes:
        emphasised |= {(len(rows), 4 + int(way)) for way in np.flatnonzero(one.deviation > _FAR)}
        rows.append(
            [
                one.shape,
                outcome.paths[one.path].title,
                quantity(one.jump),
                quantity(one.reference, one.reference_error),
                *(quantity(value, error) for value, error in zip(one.estimates, one.errors, strict=True)),
            ]
        )
    return Table(
        ("body", "path", "jumps × density", "slope", *WAYS),
        rows,
        f"Slope of the mean push by the start, from {outcome.settings.sizes.num_samples} rollouts each. In bold what is more "
        f"than {_FAR:g} standard errors off.",
        frozenset(emphasised),
    )


def _by_mating(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.matings:
        # What is left of a derivative that is zero is rounding.
        least = 1e-9 * abs(one.slopes.reference)
        says = [
            "0" if abs(value) < least else quantity(value, error)
            for value, error in zip(one.slopes.estimates, one.slopes.errors, strict=True)
        ]
        jumps = [str(len(one.force.places)), _percent(worst(one.force)), str(len(one.depth.places))]
        slope = quantity(one.slopes.reference, one.slopes.reference_error)
        rows.append([one.label, *jumps, f"{1e3 * largest(one.depth):.0f}", slope, *says])
    return Table(
        (
            "contact of peg and hole",
            "jumps of the force",
            "largest",
            "jumps of the depth",
            "largest, mm",
            "slope",
            *WAYS,
        ),
        rows,
        "Force on the held peg against its offset, jumps over the largest force; the depth that it reaches when let go; slope of "
        "its mean under noise, where it jumps most.",
    )


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _percent(share: float) -> str:
    return "none" if share < _SMALL else percent(share)
