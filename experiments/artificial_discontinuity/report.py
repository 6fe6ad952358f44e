"""The answer of an experiment on artificial discontinuities in words, computed from its numbers."""

import numpy as np

from experiments.artificial_discontinuity.outcome import GENTLE, PLAIN, WAYS, C, Judged, Outcome, largest, worst
from experiments.artificial_discontinuity.shapes import PATHS
from experiments.report import Table
from experiments.words import joined, percent, quantity

# Standard errors from which a bias is beyond chance, of some dozens of estimates.
_FAR = 4.0
_SMALL = 1e-4
# Of a jump, what the continuous reference must do nearby for it to be the same change.
_SAME = 0.5


def verdict(outcome: Outcome) -> str:
    """Say which bodies jump, and what to build contact of."""
    threshold = outcome.settings.threshold
    bodies = {name: statics for name, statics in outcome.by_shape.items() if not statics[0].is_lattice}
    most = {name: max(one.worst(GENTLE) for one in statics) for name, statics in bodies.items()}
    plain = {name: max(one.worst(PLAIN) for one in statics) for name, statics in bodies.items()}
    smooth = [name for name in bodies if most[name] <= threshold]
    rough = [f"{name} ({most[name]:.0%})" for name in bodies if most[name] > threshold]
    worse = [f"{name} ({plain[name]:.0%})" for name in smooth if plain[name] > threshold]
    sentences = []
    if rough:
        sentences.append(f"By its geometry alone the force jumps by more than {threshold:.0%} with {joined(rough)}.")
    if smooth:
        sentences.append(f"It does not with {joined(smooth)}: to differentiate through contact build it of these.")
    else:
        sentences.append(f"None of the bodies is without; the least has {min(most, key=lambda name: most[name])}.")
    if worse:
        sentences.append(
            f"Under MuJoCo's default contact it still does with {joined(worse)}: there let the impedance rise from zero (the "
            "first number of solimp)."
        )
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say what no table shows: whether jumps explain biases, what MJX has that C has not, and what friction does."""
    found = []
    jumping = [one for one in outcome.slopes if abs(one.jump) > abs(one.bias[0]) / 2 and one.deviation[0] > _FAR]
    if jumping:
        rest = [abs(one.bias[0] + one.jump) / abs(one.bias[0]) for one in jumping]
        found.append(
            f"Where the push itself jumps ({len(jumping)} of {len(outcome.slopes)}), the jump times the density of the noise is "
            f"the discrete gradient's bias, up to {np.median(rest):.0%} of it in the median."
        )
    own = [one for one in outcome.statics if len(one.jumps[PLAIN].places) > len(one.jumps[C].places)]
    if own:
        found.append(
            f"MJX has jumps that C has not at {len(own)} of {len(outcome.statics)} bodies and paths, some of them small; at "
            f"{sum(bool(one.copies.max()) for one in own)} of these it repeats contact points to fill their number, which weighs "
            "some corners twice or three times."
        )
    jumps = outcome.friction
    kind = f"jumps by {worst(jumps):.0%} at standstill" if len(jumps.places) else "has no jump left"
    width = 2 * jumps.scale / jumps.steepest if jumps.steepest else np.nan
    return [
        *found,
        f"Stick or slip, which is real, is no jump here: friction against sliding speed {kind}; the soft constraint turns it "
        f"over {quantity(1e3 * width)} mm/s.",
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate jumps by body and path, the box's jumps one by one, the estimates across them, and the peg and the hole."""
    return [_by_body(outcome), _by_jump(outcome), _by_estimate(outcome), _by_mating(outcome)]


def _by_body(outcome: Outcome) -> Table:
    rows, emphasised = [], set()
    for name, statics in outcome.by_shape.items():
        row = [name, str(statics[0].num_rows)]
        for one in statics:
            if one.worst(PLAIN) > outcome.settings.threshold:
                emphasised.add((len(rows), len(row)))
            forces = [force for force in one.jumps if force != GENTLE or not one.is_lattice]
            row.append(", ".join(_percent(one.worst(force)) for force in forces))
        rows.append(row)
    columns = ("body", "rows", *(PATHS[name].title for name in outcome.settings.sizes.paths))
    caption = (
        "Largest jump over the largest force on the path: under MuJoCo's default contact, under one that begins gently (what "
        "still jumps is of the geometry), under the default one smoothed by a Gaussian of "
        f"{1e3 * outcome.settings.smoothing:g} mm, and in C MuJoCo; lattices have a contact of their own, in mjxgrad and in C. A "
        "jump is what remains of a change after its interval was divided by millions. In bold beyond the threshold."
    )
    return Table(columns, rows, caption, frozenset(emphasised))


def _by_jump(outcome: Outcome) -> Table:
    threshold = outcome.settings.threshold
    rows = [
        [
            PATHS[one.path].title,
            f"{one.place:.4f} {PATHS[one.path].unit}".replace("-", "−"),
            " → ".join(map(str, one.contacts)),
            *(_percent(share) for share in (one.relative, one.reference_jump, one.reference_change)),
            kind(one),
        ]
        for one in outcome.judged
        if one.relative > threshold
    ]
    columns = ("path", "at", "contacts", "jump over force", "reference jumps by", "changes nearby by", "which is")
    caption = (
        f"The jumps of the box beyond {threshold:.0%} of the force beside them, of {len(outcome.judged)} in all, beside the "
        "gradient of the overlap volume, the reference; nearby is one penetration depth to each side. A jump of which it "
        "does at least half at once is real; at least half nearby: a real change, made sudden. An onset is no jump where "
        "contact begins gently."
    )
    return Table(columns, rows, caption)


def kind(one: Judged) -> str:
    """Say what a jump is, by what the reference does there."""
    if not one.is_geometric:
        return "onset of a contact under load"
    if one.reference_jump > _SAME * one.relative:
        return "real"
    return "real change, made sudden" if one.reference_change > _SAME * one.relative else "artificial"


def _by_estimate(outcome: Outcome) -> Table:
    rows = [
        [
            one.shape,
            PATHS[one.path].title,
            quantity(one.jump),
            quantity(one.reference, one.reference_error),
            *map(quantity, one.estimates, one.errors),
        ]
        for one in outcome.slopes
    ]
    emphasised = {
        (row, 4 + int(way))
        for row, one in enumerate(outcome.slopes)
        for way in np.flatnonzero(one.deviation > _FAR)
    }  # fmt: skip
    caption = (
        f"Slope of the mean push by the start, from {outcome.settings.sizes.num_samples} rollouts each. In bold what is more "
        f"than {_FAR:g} standard errors off."
    )
    return Table(("body", "path", "jumps × density", "slope", *WAYS), rows, caption, frozenset(emphasised))


def _by_mating(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.matings:
        slopes = one.slopes
        # What is left of a derivative that is zero is rounding.
        estimates = np.where(np.abs(slopes.estimates) < 1e-9 * abs(slopes.reference), 0.0, slopes.estimates)
        jumps = [str(len(one.force.places)), _percent(worst(one.force)), str(len(one.depth.places))]
        says = [
            quantity(value, error if value else None) for value, error in zip(estimates, slopes.errors, strict=True)
        ]
        slope = quantity(slopes.reference, slopes.reference_error)
        rows.append([one.label, *jumps, f"{1e3 * largest(one.depth):.0f}", slope, *says])
    columns = (
        "contact of peg and hole", "jumps of the force", "largest", "jumps of the depth", "largest, mm", "slope", *WAYS
    )  # fmt: skip
    caption = (
        "Force on the held peg against its offset, jumps over the largest force; the depth that it reaches when let go; "
        "slope of its mean under noise, where it jumps most."
    )
    return Table(columns, rows, caption)


def _percent(share: float) -> str:
    return "none" if share < _SMALL else percent(share)
