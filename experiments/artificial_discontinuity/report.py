"""The answer of an experiment on artificial discontinuities: words, tables, pictures."""

import numpy as np
from matplotlib.axes import Axes
from scipy.stats import linregress

from experiments.artificial_discontinuity.measure import GENTLE, PLAIN, TILT, WAYS, C, Judged, Outcome, largest, worst
from experiments.artificial_discontinuity.shapes import PATHS
from experiments.report import Table
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, shades, subplots
from experiments.words import capitalised, joined, named, percent, quantity
from mjxgrad.diagnostics import Jumps

# Standard errors from which a bias is beyond chance, of some dozens of estimates.
_FAR = 4.0
_SMALL = 1e-4
# Of a jump, what the continuous reference must do nearby for it to be the same change.
_SAME = 0.5


def answer(outcome: Outcome) -> str:
    """Name the bodies whose geometry alone makes force jump, and count the biased gradients across their jumps."""
    # Of the lattices, which all are points, the finest.
    bodies = {"points" if statics[0].is_lattice else name: statics for name, statics in outcome.by_shape.items()}
    rough = [name for name in bodies if max(one.worst(GENTLE) for one in bodies[name]) > outcome.settings.threshold]
    jumping = [one for one in outcome.slopes if one.jump]
    biased = sum(one.deviation[0] > _FAR for one in jumping)
    across = f"; first order is biased across {biased} of {len(jumping)} jumps" if jumping else ""
    return f"{capitalised(named(rough, len(bodies), words=6))}{across}."


def verdict(outcome: Outcome) -> str:
    """Say which bodies jump, and what to build contact of."""
    threshold = outcome.settings.threshold
    bodies = {name: statics for name, statics in outcome.by_shape.items() if not statics[0].is_lattice}
    most = {name: max(one.worst(GENTLE) for one in statics) for name, statics in bodies.items()}
    plain = {name: max(one.worst(PLAIN) for one in statics) for name, statics in bodies.items()}
    smooth = [name for name in bodies if most[name] <= threshold]
    finest = list(outcome.by_shape)[-1]
    jumps = most | {finest: max(one.worst(GENTLE) for one in outcome.by_shape[finest])}
    rough = [f"{name} ({jump:.0%})" for name, jump in jumps.items() if jump > threshold]
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


_LEAST = 1e-4


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"forces": forces, "refinement": refinement, "slopes": slopes, "mating": mating}


def forces(outcome: Outcome):
    """Forces of the box, of balls and of the finest lattice along every path, the reference dashed."""
    bodies = list(outcome.by_shape)
    figure, axes = subplots(3, len(outcome.settings.sizes.paths), height=6.2, sharex="col")
    for row, body in zip(axes, (bodies[0], _rounded(outcome), bodies[-1]), strict=True):
        for axis, static in zip(row, outcome.by_shape[body], strict=True):
            found = static.jumps[GENTLE]
            _components(axis, found.parameters, found.values[:, :3] / found.scale, "force along {}")
            _mark(axis, found, outcome.settings.threshold * found.scale)
        row[0].set_ylabel(f"{body}\nforce over its largest")
    for top, bottom, (name, volume) in zip(axes[0], axes[-1], outcome.reference.items(), strict=True):
        parameters = np.linspace(*PATHS[name].interval, len(volume))
        _components(top, parameters, volume / max(np.abs(volume).max(), 1e-12), "", lw=1.0, ls=(0, (2, 2)))
        top.set_title(PATHS[name].title)
        bottom.set_xlabel(f"{'angle' if PATHS[name].axis else 'position'}, {PATHS[name].unit}")
    axes[0, 0].plot([], [], color=FIRST, lw=1.0, ls=(0, (2, 2)), label="by overlap volume")
    legend_below(figure, axes[0, 0], 4)
    settings = outcome.settings
    caption = (
        f"Force on a body held {1e3 * settings.depth:g} mm deep in a cube, over its largest, under a contact that begins "
        "gently: what still jumps is of the geometry. Dashed, the gradient of the "
        "volume that both boxes share, scaled alike: it is continuous. Grey lines: the force jumps by more than "
        f"{settings.threshold:.0%} of that."
    )
    return figure, "Force along a path", caption


def _components(axis: Axes, parameters: np.ndarray, values: np.ndarray, label: str, **look) -> None:
    for part, colour, name in zip(values.T, (FIRST, MUTED, ZEROTH), "xyz", strict=True):
        axis.plot(parameters, part, color=colour, label=label.format(name) or None, **{"lw": 1.3, **look})


def _mark(axis: Axes, jumps: Jumps, smallest: float = 0.0, unit: float = 1.0) -> None:
    """Draw lines where something jumps."""
    for place in jumps.places[jumps.sizes > smallest]:
        axis.axvline(unit * place, color=REFERENCE, lw=0.6, alpha=0.35, zorder=0)


def refinement(outcome: Outcome):
    """Largest jump of the lattices against points along an edge, and the force along the first path."""
    figure, axes = subplots(1, 2, height=3.7)
    left, right = axes[0]
    names = outcome.settings.sizes.paths
    lattices = {name: [one for one in outcome.statics if one.is_lattice and one.path == name] for name in names}
    counts = outcome.settings.sizes.lattices
    for colour, (name, found) in zip(shades(len(names)), lattices.items(), strict=True):
        sizes = [one.worst(PLAIN) for one in found]
        # Where only a single point touches nothing is refined, and without a jump there is no logarithm.
        if len(found) >= 3 and min(sizes) > 0 and all(one.contacts.max() >= 2 for one in found):
            fit = linregress(np.log(counts), np.log(sizes))
            label = f"{PATHS[name].title}: power {quantity(float(fit.slope), float(fit.stderr))}"
            left.plot(counts, np.maximum(sizes, _LEAST), "o-", color=colour, ms=4, label=label)
    left.set(xscale="log", yscale="log", xlabel="points along an edge", title="Largest jump, over the largest force")
    left.set_xticks(counts, [str(one) for one in counts])
    low, high = left.get_ylim()
    ticks = [tick for tick in (1e-3, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.5, 1) if low < tick < high]
    left.set_yticks(ticks, [percent(tick) for tick in ticks])
    left.minorticks_off()
    first = lattices[names[0]]
    for colour, one in zip(shades(len(first)), first, strict=True):
        found = one.jumps[PLAIN]
        right.plot(found.parameters, found.values[:, 2], color=colour, lw=1.3, label=one.shape)
    right.set(xlabel="position, m", title="Force upwards as the body slides past the edge, N")
    for axis in axes[0]:
        axis.legend(fontsize=8)
    caption = (
        "Bodies that touch by points, each a spring with an equal share of the stiffness, whose force jumps where its "
        "nearest face changes: of a slide along the lattice for a whole row at once, of one askew for one point after the "
        "other. Paths on which some lattice does not jump, or a single point touches, are left out."
    )
    return figure, "A pressure field of ever more points", caption


def slopes(outcome: Outcome):
    """Outcome of a push against its start for the box and for balls."""
    figure, axes = subplots(1, 2, height=3.9)
    pushed = {one.shape: one for one in reversed(outcome.slopes)}
    # The box, and a body that does not jump; where none other was pushed, the box on another path.
    shown = [pushed[next(iter(outcome.by_shape))], pushed.get(_rounded(outcome), outcome.slopes[-1])]
    lines = (*zip(WAYS, (FIRST, ONSET, ZEROTH), ("-", "-", "-"), strict=True), ("reference", REFERENCE, (0, (2, 2))))
    for axis, one in zip(axes[0], shown, strict=True):
        path = PATHS[one.path]
        axis.plot(one.starts, 1e3 * one.outcomes, ".", color=REFERENCE, ms=2.5)
        axis.set(title=f"{one.shape}, {path.title}", xlabel=f"start, {path.unit}")
        axis.locator_params(axis="x", nbins=4)
        reach = np.array([-1.0, 1.0]) * outcome.settings.stddev * path.length
        for estimate, (label, colour, style) in zip((*one.estimates, one.reference), lines, strict=True):
            heights = 1e3 * (one.outcomes.mean() + estimate * reach)
            axis.plot(one.place + reach, heights, color=colour, lw=2, ls=style, label=label)
    axes[0, 0].set_ylabel("height after 30 ms, mm")
    legend_below(figure, axes[0, 0], 4)
    settings = outcome.settings
    caption = (
        f"The body is let go where the box's force jumps, under noise on the start of {settings.stddev:.1%} of the path; the "
        f"outcome is its height after 30 ms. Lines: slopes that {settings.sizes.num_samples} rollouts say, and the "
        "reference."
    )
    return figure, "What gradients say across the jump", caption


def mating(outcome: Outcome):
    """Force on the held peg and depth of the dropped one against the offset, by geometry."""
    figure, axes = subplots(2, len(outcome.matings), height=4.8, sharex=True, sharey="row")
    parts = ("sideways", "upwards", "torque over half the length")
    for (upper, lower), one in zip(axes.T, outcome.matings, strict=True):
        for part, colour, label in zip(one.force.values.T, (FIRST, ZEROTH, DEFAULT), parts, strict=True):
            upper.plot(1e3 * one.force.parameters, part, color=colour, lw=1.3, label=label)
        lower.plot(1e3 * one.depth.parameters, 1e3 * one.depth.values, ".", color=REFERENCE, ms=2)
        _mark(upper, one.force, unit=1e3)
        _mark(lower, one.depth, unit=1e3)
        upper.set_title(one.label)
        lower.set_xlabel("offset, mm")
    axes[0, 0].set_ylabel("held in the hole: force, N")
    axes[1, 0].set_ylabel("let go: depth at the end, mm")
    legend_below(figure, axes[0, 0], 3)
    caption = (
        f"A peg tilted by {TILT:g} rad, in and above a hole that is wider by 3 mm on each side. Points on the peg meet the "
        "boxes of the hole, points on the rim the box of the peg; where only one part has points the other's corners meet "
        "nothing. Grey lines: jumps. That the peg falls through or stays on the rim is real."
    )
    return figure, "A peg and a hole", caption


def _rounded(outcome: Outcome) -> str:
    """Return the body whose corners are balls."""
    return next(one for one in outcome.by_shape if "corners" in one)
