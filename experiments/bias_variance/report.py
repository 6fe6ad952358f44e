"""The answer of a bias and variance experiment in words, computed from its numbers."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from experiments.bias_variance.measure import Outcome
from experiments.report import Table
from experiments.theme import power
from experiments.words import joined, quantity


def verdict(outcome: Outcome) -> str:
    """Say where each estimate is to be used."""
    choice = f"With {outcome.settings.rollouts_per_gradient} rollouts per gradient {_choice(outcome.swept)}."
    return " ".join([choice, _bias(outcome), *_default(outcome)])


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate both estimates, the reference and which estimate to use."""
    table, rows, emphasised = outcome.table, [], set()
    for i, j in np.ndindex(table.bias.shape):
        one = table.isel(stiffness=i, angle=j)
        if one.is_biased:
            emphasised.add((len(rows), 5))
        gradients = [_with_half_width(one, name) for name in ("first_order", "zeroth_order", "reference", "bias")]
        row = f"default ({power(float(one.stiffness))})" if one.is_default else power(float(one.stiffness))
        rows.append(
            [
                row if j == 0 else "",
                f"{float(one.angle):g}",
                f"{gradients[0]}{' †' if one.has_wrong_sign else ''}",
                *gradients[1:],
                quantity(float(one.first_order_variance / one.zeroth_order_variance)),
                "first" if one.first_wins else "zeroth" if one.zeroth_wins else "either",
            ]
        )
    columns = (
        "stiffness, 1/s²", "angle, rad", "first order", "zeroth order", "reference", "bias of first order",
        "variance ratio", "use",
    )  # fmt: skip
    settings = outcome.settings
    caption = (
        f"Gradients in m²/rad with half the width of their {settings.confidence:.0%} intervals, from {settings.num_samples} "
        "rollouts each; † marks means of first order that surely have the wrong sign. A bias in bold differs from zero beyond "
        "chance over the whole table. The ratio is the variance of a sample of first order over that of zeroth order. The "
        "last column is the estimate with the clearly smaller expected error at "
        f"{settings.rollouts_per_gradient} rollouts per gradient."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _with_half_width(one: xr.Dataset, name: str) -> str:
    value, half = float(one[name]), float(one[f"{name}_high"] - one[f"{name}_low"]) / 2
    # Beyond three digits nobody reads on; the rest is in metrics.csv.
    return quantity(value) if half < 1e-3 * abs(value) else quantity(value, half)


def _choice(swept: xr.Dataset) -> str:
    """Say up to which stiffness zeroth order is nowhere closer, by angle, and what comes beyond."""
    zeroth, last = swept.zeroth_wins.values, swept.stiffness.size
    until = np.where(zeroth.any(axis=0), zeroth.argmax(axis=0), last)
    beyond = np.arange(last)[:, None] >= until
    if (until == last).all():
        return "first order is as close or closer at every stiffness and angle"
    if (until == 0).all() and zeroth.all():
        return "zeroth order is closer at every stiffness and angle"
    parts = []
    for end in np.unique(until)[::-1]:
        limit = f"up to {power(swept.stiffness.values[end - 1])} 1/s²"
        where = "nowhere" if end == 0 else "everywhere" if end == last else limit
        parts.append(f"{where} {_angles(swept.angle[until == end])}")
    count = f"{int((zeroth & beyond).sum())} of {int(beyond.sum())}"
    return f"first order is as close or closer {joined(parts)}, and beyond that zeroth order is closer in {count} cases"


def _angles(angles: xr.DataArray) -> str:
    return f"at {joined(f'{angle:g}' for angle in angles.values)} rad"


def _range(stiffness: xr.DataArray, rows: ArrayLike) -> str:
    """Words for the stiffnesses of some rows of the sweep: a range if they are neighbours, else a list."""
    picked = np.flatnonzero(np.asarray(rows))
    labels = [power(k) for k in stiffness.values[picked]]
    is_range = len(picked) > 2 and (np.diff(picked) == 1).all()
    return f"from {labels[0]} to {labels[-1]} 1/s²" if is_range else f"at {joined(labels)} 1/s²"


def _bias(outcome: Outcome) -> str:
    swept = outcome.swept
    biased = swept.is_biased.any("angle")
    if not biased.any():
        return f"No bias of the first-order estimate is seen in the sweep ({outcome.settings.confidence:.0%} over all cases)."
    parts = [f"The first-order estimate is measurably biased {_range(swept.stiffness, biased)}"]
    # No bias seen is no bias only where one of half the gradient's own size would have been seen.
    half_width = (swept.bias_high - swept.bias_low) / 2
    is_blind = (half_width > abs(swept.reference).max("stiffness") / 2).any("angle") & ~biased
    if is_blind.any():
        parts.append(f"{_range(swept.stiffness, is_blind)} it is too noisy to tell")
    if (is_clean := ~biased & ~is_blind).any():
        parts.append(f"{_range(swept.stiffness, is_clean)} no bias is seen")
    return "; ".join(parts) + "."


def _default(outcome: Outcome) -> list[str]:
    default = outcome.table.isel(stiffness=outcome.table.is_default.values)
    if not default.stiffness.size:
        return []
    biased, wrong, count = int(default.is_biased.sum()), int(default.has_wrong_sign.sum()), default.angle.size
    if not biased:
        return [f"Under MuJoCo's default contact no bias is seen at any of the {count} angles."]
    sign = f", and has the wrong sign at {wrong}" if wrong else ""
    return [f"Under MuJoCo's default contact it is biased at {biased} of {count} angles{sign}."]
