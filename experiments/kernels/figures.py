"""The pictures of an experiment on smoothing kernels."""

import numpy as np

from experiments.kernels.outcome import TITLES, Outcome
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots

COLOURS = {
    "gaussian": FIRST,
    "logistic": ZEROTH,
    "log_barrier": "#009e73",
    "margin": DEFAULT,
    "impedance": MUTED,
}
NAMES = TITLES | {"margin": "margin of one length", "impedance": "impedance from 0.2 to 0.9"}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"profiles": profiles, "motion": motion}


def profiles(outcome: Outcome):
    """Forces over distance, near and far, and equivalent densities."""
    figure, axes = subplots(1, 3, height=3.8)
    near, far, right = axes[0]
    length = outcome.settings.length
    for one in outcome.profiles:
        colour, width = COLOURS[one.name], 1.4 if one.name in TITLES else 1.1
        x, force = one.distance / length, one.force / (one.found.slope * length)
        near.plot(x, force, color=colour, lw=width, label=NAMES[one.name])
        if one.name in TITLES:
            far.plot(x, force, color=colour, lw=width)
        if one.found.stddev != 0:
            right.plot(one.found.noise / length, one.found.density * length, color=colour, lw=width)
        else:
            right.axvline(one.found.mean / length, color=colour, lw=width)
    x = np.linspace(-4, 4, 401)
    near.plot(x, np.maximum(-x, 0), color=REFERENCE, lw=0.9, ls=(0, (3, 2)), label="hard contact", zorder=1)
    near.set(xlim=(-2.5, 2.5), ylim=(-0.08, 2.2), title="Force, over slope × length", xlabel="distance / length")
    far.set(xlim=(0, 4), ylim=(1e-4, 1), yscale="log", title="The same, far out", xlabel="distance / length")
    right.set(xlim=(-3, 3), ylim=(-0.45, 0.75), title="Density of the noise, × length", xlabel="noise / length")
    right.axhline(0, color=MUTED, lw=0.7)
    figure.legend(*near.get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8.5)
    settings = outcome.settings
    caption = (
        "Static force of a contact against distance, in units of its slope deep inside and of the length of the noise, "
        f"{1e3 * settings.length:g} mm; in the middle on a logarithmic scale. Right, the second derivative of the same curves "
        "over their slope: the density of the noise that they are the mean over, where there is one. A margin is a shift (a "
        "point mass, drawn as a line). MuJoCo's rising impedance is negative somewhere, and so no density."
    )
    return figure, "Force at a distance, and the noise that it is", caption


def motion(outcome: Outcome):
    """Height and its derivative over time, lines smoothed and dots sampled."""
    figure, axes = subplots(1, 2, height=4.0)
    left, right = axes[0]
    left.plot(outcome.time, 1e3 * outcome.hard, color=REFERENCE, lw=1.0, ls=(0, (3, 2)), label="without noise")
    right.plot(outcome.time, outcome.hard_slope, color=REFERENCE, lw=1.0, ls=(0, (3, 2)), label="without noise")
    every = slice(None, None, max(1, len(outcome.time) // 30))
    for name, one in outcome.motions.items():
        colour = COLOURS[name]
        pairs = (
            (left, 1e3 * one.height, 1e3 * one.sampled, 1e3 * one.sampled_error),
            (right, one.slope, one.sampled_slope, one.sampled_slope_error),
        )
        for axis, line, dots, error in pairs:
            axis.plot(outcome.time, line, color=colour, label=TITLES[name])
            axis.errorbar(
                outcome.time[every], dots[every], 2 * error[every], color=colour, fmt="o", ms=3.2, lw=0.9,
                label="sampled",
            )  # fmt: skip
    left.set(title="Height (mm)", xlabel="time (s)")
    right.set(title="Derivative of the height by the start height", xlabel="time (s)")
    # The derivative without noise is one of the simulated map, and may leave the picture.
    seen = np.concatenate([np.stack([m.slope, m.sampled_slope]) for m in outcome.motions.values()])
    right.set_ylim(min(1.5 * seen.min(), -0.3), 1.2)
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside lower center", ncols=7, columnspacing=1.2, fontsize=8.5
    )
    settings = outcome.settings
    caption = (
        f"A ball thrown at a plane with {settings.speed:g} m/s. Lines: one rollout of the smoothed solver. Dots: mean over "
        f"{settings.num_rollouts} rollouts of MuJoCo's own contact whose distance is shifted by other noise in each step, "
        "with bars of two standard errors. Right, the derivative: lines by automatic differentiation of the smoothed rollout, "
        "dots by differences of the sampled mean. Dashed, MuJoCo's contact without noise and the exact derivative of its "
        "simulated map, which does not see that the time of impact moves."
    )
    return figure, "A ball that meets a plane, smoothed and sampled", caption
