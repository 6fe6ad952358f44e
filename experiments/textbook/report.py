"""The answer of an experiment on a textbook problem in words, computed from its numbers."""

import numpy as np
import xarray as xr

from experiments.report import Table
from experiments.textbook.figures import stiffness_name
from experiments.textbook.measure import Outcome
from experiments.theme import power
from experiments.words import joined, quantity


def verdict(outcome: Outcome) -> str:
    """Say which estimator is closest, and which are biased."""
    return " ".join(sentence for sentence in (_closest(outcome), _bias(outcome), _crossing(outcome)) if sentence)


def findings(outcome: Outcome) -> list[str]:
    """Say what no table shows: agreement with closed forms, slopes that were never hit, and what was left out."""
    hits = total = lost = 0
    for table in outcome.sweeps:
        exact = table.exact_rmse
        inside = (table.rmse_low <= exact * (1 + 1e-9)) & (exact <= table.rmse_high * (1 + 1e-9))
        hits, total = hits + int(inside.sum()), total + int(exact.notnull().sum())
        lost += int((outcome.settings.num_repeats - table.num_finite).max("estimator").sum())
    confidence = f"{outcome.settings.confidence:.0%}"
    agreement = f"{hits} of {total} intervals of the error contain the closed form, at {confidence} each."
    left_out = f"{lost} estimates were not finite and were left out." if lost else ""
    return [sentence for sentence in (agreement, _unseen(outcome), left_out) if sentence]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all estimators at the largest number of rollouts."""
    last, rows = outcome.by_samples.isel(setting=-1), []
    for label in last.estimator.values:
        one = {name: value.item() for name, value in last.sel(estimator=label).data_vars.items()}
        half = {name: (one[f"{name}_high"] - one[f"{name}_low"]) / 2 for name in ("bias", "rmse")}
        rows.append(
            [
                label,
                str(one["num_samples"]),
                quantity(one["mean"], half["bias"]),
                quantity(one["bias"], half["bias"]),
                quantity(one["rmse"], half["rmse"]),
                "" if np.isnan(one["exact_rmse"]) else quantity(one["exact_rmse"]),
                quantity(one["claimed_variance"] ** 0.5),
            ]
        )
    columns = ("estimator", "samples", "mean", "bias", "error", "error, closed form", "error it claims")
    caption = (
        f"At {outcome.settings.num_samples[-1]} rollouts per estimate; the gradient is {quantity(outcome.gradient)}. "
        f"Half widths are of {outcome.settings.confidence:.0%} intervals. A bias in bold differs from zero beyond chance "
        "over all numbers of rollouts. The last column is the root of the mean squared standard error of the estimates: "
        "an estimator that claims less than its error hides something."
    )
    emphasised = frozenset((int(row), 3) for row in np.flatnonzero(outcome.is_biased[-1]))
    return [Table(columns, rows, caption, emphasised)]


def _closest(outcome: Outcome) -> str:
    few, many = (_best(outcome.by_samples.isel(setting=i)) for i in (0, -1))
    low, high = outcome.settings.num_samples[0], outcome.settings.num_samples[-1]
    shown = outcome.settings.shown_stiffness
    where = "" if shown is None else f" at {stiffness_name(outcome)} = {shown:g}"
    if few == many:
        return f"From {low} to {high} rollouts{where} the smallest error is that of {few}."
    return f"With {low} rollouts{where} the smallest error is that of {few}, with {high} that of {many}."


def _best(table: xr.Dataset) -> str:
    """Name the estimator of least error, with all whose intervals overlap its own."""
    table = table.sortby("rmse")
    ties = table.estimator.values[table.rmse_low.values <= table.rmse_high.values[0]]
    return joined(ties, "or") + (" (a tie)" if len(ties) > 1 else "")


def _bias(outcome: Outcome) -> str:
    biased = outcome.is_biased
    if not biased.any():
        return "No estimator shows a bias."
    share, parts = (outcome.by_samples.bias / abs(outcome.gradient)).where(biased), []
    for label in biased.estimator.values[biased.any("setting")]:
        worst = int(np.nanargmax(abs(share.sel(estimator=label).values)))
        size = f"{share.sel(estimator=label).values[worst]:+.2g}".replace("-", "−")
        parts.append(f"{label} (by {size} of the gradient with {outcome.settings.num_samples[worst]} rollouts)")
    others = "" if len(parts) == biased.estimator.size else "; the others show no bias"
    return f"Biased beyond chance: {', '.join(parts)}{others}."


def _crossing(outcome: Outcome) -> str | None:
    """Say from which stiffness on zeroth order is closer than first order."""
    table = outcome.by_stiffness
    if table is None or not {"first order", "zeroth order"} <= set(table.estimator.values):
        return None
    first, zeroth = table.sel(estimator="first order"), table.sel(estimator="zeroth order")
    x = table.stiffness.values
    ahead = (zeroth.rmse_high < first.rmse_low).values
    behind = (zeroth.rmse_low > first.rmse_high).values
    name, count = stiffness_name(outcome), outcome.settings.samples_at_stiffness
    if ahead.any() and behind.any() and x[ahead].min() > x[behind].max():
        return (
            f"With {count} rollouts first order is closer up to {name} = {power(x[behind].max())}, zeroth order from "
            f"{power(x[ahead].min())} on."
        )
    return (
        f"With {count} rollouts zeroth order is closer at {ahead.sum()} and first order at {behind.sum()} of {len(x)} values of "
        f"{name}."
    )


def _unseen(outcome: Outcome) -> str:
    """Say whether samples tell how rare hits of the slope are, and what the first stiffness without any implies."""
    if not outcome.hits:
        return ""
    rarer = [(min(p, 1 - p), found.probability_interval) for p, found in outcome.hits]
    covered = sum(low <= p <= high for p, (low, high) in rarer)
    sentence = f"The interval of β contains the closed form at {covered} of {len(rarer)} stiffnesses."
    for x, (p, found) in zip(outcome.settings.stiffness, outcome.hits, strict=True):
        if found.num_outlying == 0:
            return (
                f"{sentence} At {stiffness_name(outcome)} = {power(x)} none of {found.num_samples} samples hit the slope and "
                f"their variance is {found.variance:.3g}; the discrepancy to the gradient implies at least "
                f"{quantity(found.implied_variance_bound)}, and the truth is {quantity((2 * x) ** 2 * p * (1 - p))}."
            )
    return sentence
