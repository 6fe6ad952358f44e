"""The answer of the experiment on the sawtooth in words, computed from its numbers."""

import numpy as np
import xarray as xr

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
from experiments.sawtooth.measure import Outcome
from experiments.words import joined


def verdict(outcome: Outcome) -> str:
    """Say whether teeth are gone, and whose mean derivative is the slope."""
    smaller, spread = _pooled(outcome, "smaller"), _pooled(outcome, "spread", CONTINUOUS)
    if not smaller.size:
        return "Nothing touches in these motions: there are no teeth."
    within = {arm: _pooled(outcome, "within", arm).mean() for arm in ARMS}
    return (
        f"The sawtooth is {np.median(smaller):.0f} times smaller in the median ({np.quantile(smaller, 0.1):.0f} at the tenth "
        f"percentile) when contacts begin within the step. The mean of the plain derivative is then the slope within two "
        f"standard errors at {within[CONTINUOUS]:.0%} of {smaller.size} readings ({within[DISCRETE]:.0%} without, "
        f"{within[EVENT]:.0%} for the event gradient), and single derivatives scatter by {np.median(spread):.2f} of it."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what the table's medians do not show: where a mean derivative is off, and how often the motion is worse."""
    sentences = []
    off = [c for c in outcome.courses if (c.excess.sel(arm=CONTINUOUS).where(c.has_impact) > 0.05).any()]
    if off:
        sentences.append(f"Some mean derivative is more than 5% beyond its error in {joined(map(_name, off))}.")
    closer = _pooled(outcome, "closer")
    if closer.size and np.isfinite(closer).all():
        sentences.append(
            f"Beside MuJoCo's motion at a step many times shorter its error is {np.median(closer):.2f} of MuJoCo's own in the "
            f"median, and larger at {np.mean(closer > 1):.0%} of the readings."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all motions."""
    rows = []
    for c in outcome.courses:
        if not c.has_impact.any():
            continue
        picked = c.where(c.has_impact)
        middle = picked.median(("time", "coordinate"))
        within = (c.within & c.has_impact).sum(("time", "coordinate"))
        row = [str(c.title.values), f"{1e3 * float(c.timestep):g}"]
        row.append(f"{float(middle.smaller):.0f} ({float(picked.smaller.min()):.1f})")
        row += [f"{value:.2g}" for value in middle.spread.values] + [f"{value:.1%}" for value in middle.error.values]
        row += [f"{value} of {int(c.has_impact.sum())}" for value in within.values]
        row.append(f"{float(middle['shift']):.2f}")
        rows.append([*row, "–" if np.isnan(middle.closer) else f"{float(middle.closer):.2f}"])
    columns = ["motion", "time step, ms", "sawtooth smaller, times"]
    columns += [f"{what}, {arm}" for what in ("spread", "error", "within 2 errors") for arm in ARMS]
    columns += ["shift of the mean", "off the converged motion"]
    caption = (
        "Medians over times and coordinates with an impact before them; in brackets the least. Spread: standard deviation of "
        "single derivatives about their trend, over the slope. Error: of the mean derivative, over the slope of its own outcome, "
        "sampling errors included; within 2 errors: readings where it is no more than these. Shift of the mean outcome over "
        "MuJoCo's sawtooth. Distance of the outcome from the converged motion over MuJoCo's own."
    )
    return [Table(columns, rows, caption)]


def _pooled(outcome: Outcome, name: str, arm: str | None = None) -> np.ndarray:
    """Give a number at every reading with an impact before it, of all motions."""
    picked = [(c[name] if arm is None else c[name].sel(arm=arm), c.has_impact) for c in outcome.courses]
    return np.concatenate([values.values[has_impact.values] for values, has_impact in picked])


def _name(course: xr.Dataset) -> str:
    return f"{course.title.values}, {1e3 * float(course.timestep):g} ms"
