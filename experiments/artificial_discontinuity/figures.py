"""The pictures of an experiment on artificial discontinuities."""

import numpy as np
from matplotlib.axes import Axes
from scipy.stats import linregress

from experiments.artificial_discontinuity.outcome import PLAIN, WAYS, Outcome
from experiments.artificial_discontinuity.pushes import TILT
from experiments.artificial_discontinuity.shapes import PATHS
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, shades, subplots
from experiments.words import percent, quantity
from mjxgrad.diagnostics import Jumps

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
            found = static.jumps[PLAIN]
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
        f"Force on a body held {1e3 * settings.depth:g} mm deep in a cube, over its largest. Dashed, the gradient of the "
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
