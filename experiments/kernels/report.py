"""The answer of an experiment on smoothing kernels: words, tables, pictures."""

import re

import numpy as np

from experiments.kernels.measure import WAYS, Outcome
from experiments.report import Table
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.words import capitalised, joined, quantity

# Beyond it, of some twenty numbers, none is expected by chance.
_FAR = 4.0


def verdict(outcome: Outcome) -> str:
    """Say which profiles are noise, and whether the smoothed solver is the mean over it."""
    noisy = [NAMES[name] for name, found in outcome.noise.items() if found.is_noise and found.stddev > 0]
    others = [NAMES[name] for name, found in outcome.noise.items() if not found.is_noise]
    motion = outcome.motion
    height = float(abs(motion.height - motion.sampled).max())
    slope = float(abs(motion.slope - motion.sampled_slope).max())
    last = motion.isel(time=-1)
    ends = [
        f"{quantity(float(one.sampled_slope), float(one.sampled_slope_error))} ({TITLES[str(one.kernel.values)]})"
        for one in (last.isel(kernel=i) for i in range(last.kernel.size))
    ]
    return (
        f"Equivalent to noise on the distance: {joined(noisy or ['none'])}; to none: {joined(others or ['no profile'])}. The "
        f"smoothed rollout is within {1e3 * height:.2g} mm of the mean over sampled noise, and its derivative within "
        f"{slope:.2g} of that mean's slope. That slope ends at {joined(ends)}; without noise the derivative ends at "
        f"{quantity(float(last.hard_slope))}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what each profile is as noise, and how often A and B agree."""
    found = [f"{capitalised(NAMES[name])}: {_describe(one)}." for name, one in outcome.noise.items()]
    for way in WAYS[:0:-1]:
        close = outcome.linear.deviation.sel(way=way) <= _FAR
        found.append(
            f"A and B by {way} agree with the smoothed solver within {_FAR:g} standard errors in {int(close.sum())} of "
            f"{close.size} entries."
        )
    return found


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate A and B three ways."""
    rows, emphasised = [], set()
    linear = outcome.linear.stack(row=("kernel", "velocity", "entry")).transpose("row", "way")
    for i, (kernel, velocity, entry) in enumerate(linear.row.values):
        one = linear.isel(row=i)
        cells = [quantity(v, e or None) for v, e in zip(one.value.values, one.error.values, strict=True)]
        rows.append([TITLES[kernel], f"{velocity:g}".replace("-", "−"), entry, *cells])
        emphasised |= {(i, 3 + int(j)) for j in np.flatnonzero(one.deviation > _FAR)}
    caption = (
        "Derivatives of the velocity after one step, half a length above the plane, at rest and approaching. In bold what is "
        f"more than {_FAR:g} standard errors from the smoothed solver. Derivatives of sampled steps do not know that noise moves "
        "the surface past the body: where the force jumps there, at an approach, their mean misses the jump."
    )
    return [Table(("kernel", "velocity (m/s)", "derivative", *WAYS), rows, caption, frozenset(emphasised))]


def _describe(found) -> str:
    if not found.is_noise:
        text = found.reason
    elif found.stddev == 0:
        text = f"noise of no width, shifted by {1e3 * found.mean:.3g} mm"
    else:
        width = "infinite" if np.isinf(found.stddev) else f"{1e3 * found.stddev:.3g} mm"
        text = f"{found.reason}, mean {1e3 * found.mean:.2g} mm, standard deviation {width}"
    return re.sub(r"-(?=\d)", "−", text)


COLOURS = {"gaussian": FIRST, "logistic": ZEROTH, "log_barrier": ONSET, "margin": DEFAULT, "impedance": MUTED}
TITLES = {"gaussian": "Gaussian", "logistic": "logistic", "log_barrier": "log barrier"}
NAMES = TITLES | {"margin": "margin of one length", "impedance": "impedance from 0.2 to 0.9"}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"profiles": profiles, "motion": motion}


def profiles(outcome: Outcome):
    """Forces over distance, near and far, and equivalent densities."""
    figure, axes = subplots(1, 3, height=3.8)
    near, far, right = axes[0]
    length = outcome.settings.length
    x = outcome.force.distance.values / length
    for name, found in outcome.noise.items():
        look = {"color": COLOURS[name], "lw": 1.4 if name in TITLES else 1.1}
        force = outcome.force.sel(profile=name) / (found.slope * length)
        near.plot(x, force, label=NAMES[name], **look)
        if name in TITLES:
            far.plot(x, force, **look)
        if found.stddev != 0:
            right.plot(found.noise / length, found.density * length, **look)
        else:
            right.axvline(found.mean / length, **look)
    near.plot(x, np.maximum(-x, 0), color=REFERENCE, lw=0.9, ls=(0, (3, 2)), label="hard contact", zorder=1)
    near.set(xlim=(-2.5, 2.5), ylim=(-0.08, 2.2), title="Force, over slope × length", xlabel="distance / length")
    far.set(xlim=(0, 4), ylim=(1e-4, 1), yscale="log", title="The same, far out", xlabel="distance / length")
    right.set(xlim=(-3, 3), ylim=(-0.45, 0.75), title="Density of the noise, × length", xlabel="noise / length")
    right.axhline(0, color=MUTED, lw=0.7)
    legend_below(figure, near, 6)
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
    found, time = outcome.motion, outcome.motion.time.values
    few = found.isel(time=slice(None, None, max(1, len(time) // 30)))
    panels = ((left, 1e3, "hard", "height", "sampled"), (right, 1.0, "hard_slope", "slope", "sampled_slope"))
    for axis, scale, hard, line, dots in panels:
        axis.plot(time, scale * found[hard], color=REFERENCE, lw=1.0, ls=(0, (3, 2)), label="without noise")
        for name in found.kernel.values:
            one, look = few.sel(kernel=name), {"color": COLOURS[name], "fmt": "o", "ms": 3.2, "lw": 0.9}
            axis.plot(time, scale * found[line].sel(kernel=name), color=COLOURS[name], label=TITLES[name])
            axis.errorbar(one.time, scale * one[dots], 2 * scale * one[f"{dots}_error"], label="sampled", **look)
    left.set(title="Height (mm)", xlabel="time (s)")
    right.set(title="Derivative of the height by the start height", xlabel="time (s)")
    # The derivative without noise is one of the simulated map, and may leave the picture.
    right.set_ylim(min(1.5 * float(found[["slope", "sampled_slope"]].to_array().min()), -0.3), 1.2)
    legend_below(figure, left, 7)
    settings = outcome.settings
    caption = (
        f"A ball thrown at a plane with {settings.speed:g} m/s. Lines: one rollout of the smoothed solver. Dots: mean over "
        f"{settings.num_rollouts} rollouts of MuJoCo's own contact whose distance is shifted by other noise in each step, "
        "with bars of two standard errors. Right, the derivative: lines by automatic differentiation of the smoothed rollout, "
        "dots by differences of the sampled mean. Dashed, MuJoCo's contact without noise and the exact derivative of its "
        "simulated map, which does not see that the time of impact moves."
    )
    return figure, "A ball that meets a plane, smoothed and sampled", caption
