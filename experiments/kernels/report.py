"""The answer of an experiment on smoothing kernels in words, computed from its numbers."""

import re

import numpy as np

from experiments.kernels.figures import NAMES, TITLES
from experiments.kernels.measure import WAYS, Outcome
from experiments.report import Table
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
