"""The answer of an experiment on a textbook problem in words, computed from its numbers."""

import numpy as np

from experiments.report import Table
from experiments.textbook.figures import stiffness_name
from experiments.textbook.outcome import Outcome
from experiments.theme import power
from experiments.words import joined, quantity


def verdict(outcome: Outcome) -> str:
    """Say which estimator is closest, and which are biased."""
    return " ".join(sentence for sentence in (_closest(outcome), _bias(outcome), _crossing(outcome)) if sentence)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    return [sentence for sentence in (_agreement(outcome), _unseen(outcome), _left_out(outcome)) if sentence]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all estimators at the largest number of rollouts."""
    last = outcome.by_samples[-1]
    rows, emphasised = [], set()
    for row, label in enumerate(outcome.labels):
        if outcome.is_biased[-1, row]:
            emphasised.add((row, 3))
        exact = outcome.exact_by_samples.get(label)
        rows.append(
            [
                label,
                str(int(last.num_samples[row])),
                quantity(last.mean[row, 0], _half(last.bias_interval[:, row, 0])),
                quantity(last.bias[row, 0], _half(last.bias_interval[:, row, 0])),
                quantity(last.rmse[row], _half(last.rmse_interval[:, row])),
                "" if exact is None else quantity(exact[-1]),
                quantity(float(np.sqrt(last.claimed_variance[row]))),
            ]
        )
    columns = ("estimator", "samples", "mean", "bias", "error", "error, closed form", "error it claims")
    caption = (
        f"At {outcome.settings.num_samples[-1]} rollouts per estimate; the gradient is {quantity(outcome.gradient)}. "
        f"Half widths are of {outcome.settings.confidence:.0%} intervals. A bias in bold differs from zero beyond chance "
        "over all numbers of rollouts. The last column is the root of the mean squared standard error of the estimates: "
        "an estimator that claims less than its error hides something."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _closest(outcome: Outcome) -> str:
    first, last = outcome.by_samples[0], outcome.by_samples[-1]
    few, many = (_best(outcome, tables.rmse, tables.rmse_interval) for tables in (first, last))
    low, high = outcome.settings.num_samples[0], outcome.settings.num_samples[-1]
    where = f" at {stiffness_name(outcome)} = {outcome.settings.shown_stiffness:g}" if outcome.by_stiffness else ""
    if few == many:
        return f"From {low} to {high} rollouts{where} the smallest error is that of {few}."
    return f"With {low} rollouts{where} the smallest error is that of {few}, with {high} that of {many}."


def _best(outcome: Outcome, errors: np.ndarray, intervals: np.ndarray) -> str:
    """Name the estimator of least error, with all whose intervals overlap its own."""
    best = int(np.argmin(errors))
    ties = [outcome.labels[row] for row in np.argsort(errors) if intervals[0, row] <= intervals[1, best]]
    return joined(ties, "or") + (" (a tie)" if len(ties) > 1 else "")


def _bias(outcome: Outcome) -> str:
    if not outcome.is_biased.any():
        return "No estimator shows a bias."
    share = np.array([table.bias[:, 0] for table in outcome.by_samples]) / abs(outcome.gradient)
    parts = []
    for row in np.flatnonzero(outcome.is_biased.any(axis=0)):
        worst = int(np.argmax(np.where(outcome.is_biased[:, row], np.abs(share[:, row]), 0)))
        size = f"{share[worst, row]:+.2g}".replace("-", "−")
        parts.append(
            f"{outcome.labels[row]} (by {size} of the gradient with {outcome.settings.num_samples[worst]} rollouts)"
        )
    others = "" if outcome.is_biased.any(axis=0).all() else "; the others show no bias"
    return f"Biased beyond chance: {', '.join(parts)}{others}."


def _crossing(outcome: Outcome) -> str | None:
    """Say from which stiffness on zeroth order is closer than first order."""
    if not outcome.by_stiffness or not {"first order", "zeroth order"} <= set(outcome.labels):
        return None
    first, zeroth = outcome.labels.index("first order"), outcome.labels.index("zeroth order")
    x = np.asarray(outcome.settings.stiffness)
    ahead = np.array([t.rmse_interval[1, zeroth] < t.rmse_interval[0, first] for t in outcome.by_stiffness])
    behind = np.array([t.rmse_interval[0, zeroth] > t.rmse_interval[1, first] for t in outcome.by_stiffness])
    name, count = stiffness_name(outcome), outcome.settings.samples_at_stiffness
    if not ahead.any() or not behind.any():
        winner = "zeroth" if ahead.any() else "first" if behind.any() else None
        return winner and f"With {count} rollouts {winner} order is as close or closer at every {name} of the sweep."
    if x[ahead].min() > x[behind].max():
        return (
            f"With {count} rollouts first order is closer up to {name} = {power(x[behind].max())}, zeroth order from "
            f"{power(x[ahead].min())} on."
        )
    return f"With {count} rollouts zeroth order is closer at {ahead.sum()} of {len(x)} values of {name}."


def _agreement(outcome: Outcome) -> str:
    hits, total = outcome.agreement
    return (
        f"{hits} of {total} intervals of the error contain the closed form, at {outcome.settings.confidence:.0%} each."
    )


def _unseen(outcome: Outcome) -> str | None:
    if outcome.missing is None:
        return None
    x, found = np.asarray(outcome.settings.stiffness), outcome.missing.found
    covered = [
        one.probability_interval[0] <= min(p, 1 - p) <= one.probability_interval[1]  # of the rarer side
        for one, p in zip(found, outcome.missing.probability, strict=True)
    ]
    sentence = f"The interval of β contains the closed form at {sum(covered)} of {len(x)} stiffnesses."
    unseen = [i for i, one in enumerate(found) if one.num_outlying == 0]
    if not unseen:
        return sentence
    i = unseen[0]
    p = outcome.missing.probability[i]
    return (
        f"{sentence} At {stiffness_name(outcome)} = {power(x[i])} none of {found[i].num_samples} samples hit the slope "
        f"and their variance is {found[i].variance:.3g}; the discrepancy to the gradient implies at least "
        f"{quantity(found[i].implied_variance_bound)}, and the truth is {quantity((2 * x[i]) ** 2 * p * (1 - p))}."
    )


def _left_out(outcome: Outcome) -> str | None:
    count = sum(int(t.num_repeats - t.num_finite.min()) for t in [*outcome.by_samples, *outcome.by_stiffness])
    return f"{count} estimates were not finite and were left out." if count else None


def _half(ends: np.ndarray) -> float:
    return float(ends[1] - ends[0]) / 2
