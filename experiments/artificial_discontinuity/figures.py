"""The pictures of an experiment on artificial discontinuities."""

import numpy as np

from experiments.artificial_discontinuity.mating import TILT
from experiments.artificial_discontinuity.outcome import WAYS, Outcome, worst
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, shades, subplots

_EVENT = "#009e73"
_LEAST = 1e-4


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"forces": forces, "jumps": jumps, "refinement": refinement, "slopes": slopes, "mating": mating}


def forces(outcome: Outcome):
    """Forces of the box, of balls and of the finest lattice along every path, the reference dashed."""
    names = list(outcome.paths)
    figure, axes = subplots(3, len(names), height=6.2, sharex="col")
    bodies = [outcome.shapes[0], _rounded(outcome), outcome.shapes[-1]]
    for row, body in enumerate(bodies):
        for column, static in enumerate(outcome.of(body)):
            axis, path = axes[row, column], outcome.paths[static.path]
            force = static.plain.values[:, :3] / static.plain.scale
            for part, colour, label in zip(force.T, (FIRST, MUTED, ZEROTH), "xyz", strict=True):
                axis.plot(static.plain.parameters, part, color=colour, lw=1.3, label=f"force along {label}")
            if row == 0:
                volume = outcome.reference[static.path]
                size = max(np.abs(volume).max(), 1e-12)
                for part, colour in zip(volume.T, (FIRST, MUTED, ZEROTH), strict=True):
                    label = "by overlap volume" if colour == FIRST else None
                    axis.plot(static.plain.parameters, part / size, color=colour, lw=1.0, ls=(0, (2, 2)), label=label)
                axis.set_title(path.title)
            for place in static.plain.places[static.plain.sizes > outcome.settings.threshold * static.plain.scale]:
                axis.axvline(place, color=REFERENCE, lw=0.6, alpha=0.35, zorder=0)
            if row == 2:
                axis.set_xlabel(f"position, {path.unit}" if path.unit == "m" else f"angle, {path.unit}")
            if column == 0:
                axis.set_ylabel(f"{body}\nforce over its largest")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8.5)
    settings = outcome.settings
    caption = (
        f"Force on a body held {1e3 * settings.depth:g} mm deep in a cube, over its largest. Dashed, the gradient of the "
        "volume that both boxes share, scaled alike: it is continuous. Grey lines: places where the force jumps by more than "
        f"{settings.threshold:.0%} of that."
    )
    return figure, "Force along a path", caption


def jumps(outcome: Outcome):
    """Largest relative jump by body and path: as it is, smoothed, and in C MuJoCo."""
    names = list(outcome.paths)
    figure, axes = subplots(1, len(names), height=0.9 + 0.3 * len(outcome.shapes), sharey=True)
    places = np.arange(len(outcome.shapes))[::-1]
    for axis, name in zip(axes[0], names, strict=True):
        statics = [one for one in outcome.statics if one.path == name]
        axis.plot(
            [_shown(one.worst) for one in statics], places, "o", color=FIRST, ms=6, label="MuJoCo's default contact"
        )
        axis.plot(
            [_shown(one.geometric) for one in statics],
            places,
            "D",
            color=_EVENT,
            mfc="none",
            ms=7,
            label="contact that begins gently",
        )
        axis.plot(
            [_shown(worst(one.c_mujoco)) for one in statics],
            places,
            "x",
            color=REFERENCE,
            ms=5,
            label="default contact in C MuJoCo",
        )
        smoothed = [(_shown(worst(one.smoothed)), y) for one, y in zip(statics, places, strict=True) if one.smoothed]
        axis.plot(*zip(*smoothed, strict=True), "s", color=ZEROTH, mfc="none", ms=8, label="default contact, smoothed")
        axis.axvline(outcome.settings.threshold, color=MUTED, lw=1, ls=(0, (2, 3)))
        axis.set(xscale="log", xlim=(0.6 * _LEAST, 3), title=outcome.paths[name].title)
        axis.set_xticks([_LEAST, 1e-3, 1e-2, 0.1, 1], labels=["none", "0.1%", "1%", "10%", "100%"], fontsize=7)
        axis.minorticks_off()
    axes[0, 0].set_yticks(places, outcome.shapes)
    axes[0, len(names) // 2].set_xlabel("largest jump, over the largest force on the path")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8.5)
    settings = outcome.settings
    caption = (
        "A jump is what remains of a change after its interval was divided by millions; force and torque together, over the "
        "largest on the path. Contact that begins gently has an impedance that rises from zero: what still jumps is of the "
        f"geometry. Smoothing is Gaussian, of {1e3 * settings.smoothing:g} mm. Dotted, {settings.threshold:.0%}."
    )
    return figure, "Largest jump, by body and path", caption


def refinement(outcome: Outcome):
    """Largest jump of the lattices against points along an edge, and the force along the first path."""
    figure, axes = subplots(1, 2, height=3.7)
    left, right = axes[0]
    colours = shades(len(outcome.paths))
    for colour, name in zip(colours, outcome.paths, strict=True):
        power = outcome.rate(name)[0]
        if np.isnan(power):
            continue
        lattices = [one for one in outcome.statics if one.is_lattice and one.path == name]
        count = np.sqrt([one.num_rows for one in lattices])
        size = [max(one.worst, _LEAST) for one in lattices]
        label = f"{outcome.paths[name].title}: power {-power:.1f}".replace("-", "−")
        left.plot(count, size, "o-", color=colour, ms=4, label=label)
    left.set(xscale="log", yscale="log", xlabel="points along an edge", title="Largest jump, over the largest force")
    counts = sorted({round(np.sqrt(one.num_rows)) for one in outcome.statics if one.is_lattice})
    left.set_xticks(counts, [str(one) for one in counts])
    left.minorticks_off()
    left.legend(fontsize=8)
    first = [one for one in outcome.statics if one.is_lattice and one.path == next(iter(outcome.paths))]
    for colour, one in zip(shades(len(first)), first, strict=True):
        right.plot(one.plain.parameters, one.plain.values[:, 2], color=colour, lw=1.3, label=one.shape)
    right.set(xlabel="position, m", title="Force upwards as the body slides past the edge, N")
    right.legend(fontsize=8)
    caption = (
        "Bodies that touch by points, each a spring of its own with an equal share of the stiffness. Each point's force jumps "
        "where its nearest face changes; of a slide along the lattice a whole row does so at once, of one askew one point "
        "after the other. Paths on which some lattice does not jump, or a single point touches, are left out."
    )
    return figure, "A pressure field of ever more points", caption


def slopes(outcome: Outcome):
    """Outcome of a push against its start for the box and for balls, and all errors of the estimates."""
    figure, axes = subplots(1, 3, height=3.9, width_ratios=(1, 1, 1.5))
    pushed = {one.shape: one for one in reversed(outcome.slopes)}
    # The box, and a body that does not jump; where none other was pushed, the box on another path.
    shown = [pushed[outcome.shapes[0]], pushed.get(_rounded(outcome), outcome.slopes[-1])]
    for axis, one in zip(axes[0], shown, strict=False):
        path = outcome.paths[one.path]
        axis.plot(one.starts, 1e3 * one.outcomes, ".", color=REFERENCE, ms=2.5)
        axis.set(title=f"{one.shape}, {path.title}", xlabel=f"start, {path.unit}")
        axis.locator_params(axis="x", nbins=4)
        for estimate, colour, label in zip(
            (*one.estimates, one.reference), (FIRST, _EVENT, ZEROTH, REFERENCE), (*WAYS, "reference"), strict=True
        ):
            reach = np.array([-1.0, 1.0]) * outcome.settings.stddev * path.length
            style = {"ls": (0, (2, 2))} if label == "reference" else {}
            axis.plot(
                one.place + reach,
                1e3 * (one.outcomes.mean() + estimate * reach),
                color=colour,
                lw=2,
                label=label,
                **style,
            )
    axes[0, 0].set_ylabel("height after 30 ms, mm")
    _errors(outcome, axes[0, 2])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8.5)
    settings = outcome.settings
    caption = (
        f"The body is let go and pushed for 30 ms; the outcome is its height. Noise on the start of {settings.stddev:.1%} of "
        f"the path, at the place where the box's force jumps. Lines: slopes that {settings.sizes.num_samples} rollouts say, "
        "and the reference. Right: errors for all bodies, one mark per path."
    )
    return figure, "What gradients say across the jump", caption


def _errors(outcome: Outcome, axis) -> None:
    """Draw the error of each estimate over the reference, body by body."""
    bodies = list(dict.fromkeys(one.shape for one in outcome.slopes))
    looks = ((FIRST, "o", 0.0), (_EVENT, "^", -0.18), (ZEROTH, "s", -0.36))
    for one in outcome.slopes:
        scale = max(abs(one.reference), np.abs(one.estimates[:2]).max(), 1e-12)
        y = len(bodies) - bodies.index(one.shape)
        for error, (colour, marker, shift) in zip(np.abs(one.bias) / scale, looks, strict=True):
            axis.plot(np.clip(error, 1e-3, None), y + shift, marker, color=colour, ms=4.5, mec="none", alpha=0.75)
    axis.set_yticks(len(bodies) - np.arange(len(bodies)), bodies)
    axis.set(xscale="log", title="Error, over the larger of slope and first order", xlabel="one mark per path")
    axis.set_xticks([1e-3, 1e-2, 0.1, 1], labels=["≤ 0.1%", "1%", "10%", "100%"])
    axis.minorticks_off()


def mating(outcome: Outcome):
    """Force on the held peg and depth of the dropped one against the offset, by geometry."""
    figure, axes = subplots(2, len(outcome.matings), height=4.8, sharex=True, sharey="row")
    for column, one in enumerate(outcome.matings):
        upper, lower = axes[:, column]
        for part, colour, label in zip(one.force.values.T, (FIRST, ZEROTH, DEFAULT), _PARTS, strict=True):
            upper.plot(1e3 * one.force.parameters, part, color=colour, lw=1.3, label=label)
        lower.plot(1e3 * one.depth.parameters, 1e3 * one.depth.values, ".", color=REFERENCE, ms=2)
        for axis, found in ((upper, one.force), (lower, one.depth)):
            for place in found.places:
                axis.axvline(1e3 * place, color=REFERENCE, lw=0.6, alpha=0.35, zorder=0)
        upper.set_title(one.label)
        lower.set_xlabel("offset, mm")
    axes[0, 0].set_ylabel("held in the hole: force, N")
    axes[1, 0].set_ylabel("let go: depth at the end, mm")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8.5)
    caption = (
        f"A peg tilted by {TILT:g} rad, in and above a hole that is wider by 3 mm on each side. Points on the peg meet the "
        "boxes of the hole, points on the rim the box of the peg; where only one part has points the other's corners meet "
        "nothing. Grey lines: jumps. That the peg falls through or stays on the rim is real."
    )
    return figure, "A peg and a hole", caption


_PARTS = ("sideways", "upwards", "torque over half the length")


def _rounded(outcome: Outcome) -> str:
    """Return the body whose corners are balls."""
    return next(one for one in outcome.shapes if "corners" in one)


def _shown(jump: float) -> float:
    return max(jump, _LEAST)
