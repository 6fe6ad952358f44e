"""The answer of an experiment on smoothing kernels in words, computed from its numbers."""

import re

import numpy as np

from experiments.kernels.figures import NAMES
from experiments.kernels.outcome import ENTRIES, TITLES, WAYS, Outcome
from experiments.report import Table
from experiments.words import capitalised, quantity

# Beyond it, of some twenty numbers, none is expected by chance.
_FAR = 4.0


def verdict(outcome: Outcome) -> str:
    """Say which profiles are noise, and whether the smoothed solver is the mean over it."""
    noisy = [NAMES[one.name] for one in outcome.profiles if one.found.is_noise and one.found.stddev > 0]
    others = [NAMES[one.name] for one in outcome.profiles if not one.found.is_noise]
    sentence = f"Equivalent to noise on the distance: {', '.join(noisy) or 'none'}; to none: {', '.join(others) or 'no profile'}."
    height, slope = _motion_errors(outcome)
    return (
        f"{sentence} The smoothed rollout is within {1e3 * height:.2g} mm of the mean over sampled noise, and its derivative "
        f"within {slope:.2g} of that mean's slope, which ends at {_ends(outcome)}; without noise the derivative ends at "
        f"{outcome.hard_slope[-1]:.3g}.".replace("-", "−")
    )


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    found = [f"{capitalised(NAMES[one.name])}: {_describe(one.found)}." for one in outcome.profiles]
    for way in (2, 1):
        close, total = 0, 0
        for states in outcome.linear.values():
            for one in states:
                close += int((one.deviation[:, way] <= _FAR).sum())
                total += len(ENTRIES)
        found.append(
            f"A and B by {WAYS[way]} agree with the smoothed solver within {_FAR:g} standard errors in {close} of {total} "
            "entries."
        )
    return found


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate A and B three ways."""
    rows, emphasised = [], set()
    for name, states in outcome.linear.items():
        for one in states:
            for i, entry in enumerate(ENTRIES):
                cells = [quantity(v, e if e > 0 else None) for v, e in zip(one.value[i], one.error[i], strict=True)]
                emphasised |= {(len(rows), 3 + j) for j in np.flatnonzero(one.deviation[i] > _FAR)}
                rows.append([TITLES[name], f"{one.velocity:g}".replace("-", "−"), entry, *cells])
    caption = (
        "Derivatives of the velocity after one step, half a length above the plane, at rest and approaching. In bold what is "
        f"more than {_FAR:g} standard errors from the smoothed solver. Derivatives of sampled steps do not know that noise moves "
        "the surface past the body: where the force jumps there, at an approach, their mean misses the jump."
    )
    return [Table(("kernel", "velocity (m/s)", "derivative", *WAYS), rows, caption, frozenset(emphasised))]


def _describe(found) -> str:
    if not found.is_noise:
        return re.sub(r"-(?=\d)", "−", found.reason)
    if found.stddev == 0:
        return f"noise of no width, shifted by {1e3 * found.mean:.3g} mm".replace("-", "−")
    width = "infinite" if np.isinf(found.stddev) else f"{1e3 * found.stddev:.3g} mm"
    return f"{found.reason}, mean {1e3 * found.mean:.2g} mm, standard deviation {width}".replace("-", "−")


def _motion_errors(outcome: Outcome) -> tuple[float, float]:
    every = outcome.motions.values()
    height = max(float(np.abs(m.height - m.sampled).max()) for m in every)
    return height, max(float(np.abs(m.slope - m.sampled_slope).max()) for m in every)


def _ends(outcome: Outcome) -> str:
    parts = [
        f"{quantity(m.sampled_slope[-1], m.sampled_slope_error[-1])} ({TITLES[k]})" for k, m in outcome.motions.items()
    ]
    return ", ".join(parts)
