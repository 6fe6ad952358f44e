"""The answer of a bias and variance experiment in words, computed from its numbers."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from experiments.bias_variance.outcome import Outcome
from experiments.report import Table
from experiments.theme import power
from experiments.words import joined, quantity


def verdict(outcome: Outcome) -> str:
    """Say where each estimate is to be used."""
    choice = f"With {outcome.settings.rollouts_per_gradient} rollouts per gradient {_choice(outcome)}."
    return " ".join([choice, _bias(outcome), *_default(outcome)])


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    return [
        sentence
        for sentence in (_worst_bias(outcome), _wrong_signs(outcome), _variance(outcome))
        if sentence is not None
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate both estimates, the reference and which estimate to use."""
    rows, emphasised = [], set()
    for i, j in np.ndindex(outcome.bias.value.shape):
        use = "first" if outcome.first_wins[i, j] else "zeroth" if outcome.zeroth_wins[i, j] else "either"
        if outcome.is_biased[i, j]:
            emphasised.add((len(rows), 5))
        rows.append(
            [
                name(outcome, i) if j == 0 else "",
                f"{outcome.angles[j]:g}",
                *(_with_half_width(interval, i, j) for interval in (outcome.first, outcome.zeroth, outcome.reference)),
                _with_half_width(outcome.bias, i, j),
                quantity(outcome.first_variance.value[i, j] / outcome.zeroth_variance.value[i, j]),
                use,
            ]
        )
    columns = (
        "stiffness, 1/s²",
        "angle, rad",
        "first order",
        "zeroth order",
        "reference",
        "bias of first order",
        "variance ratio",
        "use",
    )
    percent = f"{outcome.settings.confidence:.0%}"
    caption = (
        f"Gradients in m²/rad with half the width of their {percent} intervals, from {outcome.settings.num_samples} rollouts "
        "each. "
        "A bias in bold differs from zero beyond chance over the whole table. The ratio is the variance of a sample of "
        "first order over that of zeroth order. The last column is the estimate with the clearly "
        f"smaller expected error at {outcome.settings.rollouts_per_gradient} rollouts per gradient."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def name(outcome: Outcome, i: int) -> str:
    """Name a row: its stiffness, or that it is the default."""
    return power(outcome.stiffness[i]) if i < outcome.swept.stop else f"default ({power(outcome.stiffness[i])})"


def _with_half_width(interval, i: int, j: int) -> str:
    value, half = interval.value[i, j], (interval.high[i, j] - interval.low[i, j]) / 2
    # Beyond three digits nobody reads on; the rest is in metrics.csv.
    return quantity(value) if half < 1e-3 * abs(value) else quantity(value, half)


def _choice(outcome: Outcome) -> str:
    """Say which estimate is closer: by stiffness or by angle, whichever leaves less undecided."""
    first, zeroth = outcome.first_wins[outcome.swept], outcome.zeroth_wins[outcome.swept]
    if not zeroth.any():
        return f"first order is {_degree(first)} at every stiffness and angle"
    if not first.any():
        return f"zeroth order is {_degree(zeroth)} at every stiffness and angle"
    by_stiffness = _sides(first, zeroth, lambda rows: f"at every angle {_range(outcome, rows)}")
    by_angle = _sides(first.T, zeroth.T, lambda columns: f"{_angles(outcome, columns)} at every stiffness")
    parts, _ = min(by_stiffness, by_angle, key=lambda sides: sides[1])
    return joined(parts)


def _sides(first: np.ndarray, zeroth: np.ndarray, words: Callable[[ArrayLike], str]) -> tuple[list[str], int]:
    """Describe the groups (rows) where one estimate never loses, and the others, with the number of their cases."""
    ties = ~first.any(axis=1) & ~zeroth.any(axis=1)
    sides = {"first order": (first, ~zeroth.any(axis=1) & ~ties), "zeroth order": (zeroth, ~first.any(axis=1) & ~ties)}
    parts = [f"{name} is {_degree(wins[rows])} {words(rows)}" for name, (wins, rows) in sides.items() if rows.any()]
    if ties.any():
        parts.append(f"both are as close {words(ties)}")
    mixed = first.any(axis=1) & zeroth.any(axis=1)
    if mixed.any():
        count = f"{first[mixed].sum()} to {zeroth[mixed].sum()} of {first[mixed].size} cases"
        parts.append(f"it is mixed {words(mixed)} (first order to zeroth order: {count})")
    return parts, int(first[mixed].size)


def _degree(wins: np.ndarray) -> str:
    return "closer" if wins.all() else "as close or closer"


def _angles(outcome: Outcome, columns: ArrayLike) -> str:
    return f"at {joined([f'{angle:g}' for angle in outcome.angles[np.asarray(columns)]])} rad"


def _range(outcome: Outcome, rows: ArrayLike) -> str:
    """Words for the stiffnesses of some rows of the sweep: a range if they are neighbours, else a list."""
    picked = np.flatnonzero(np.asarray(rows))
    labels = [power(k) for k in outcome.stiffness[picked]]
    if len(picked) == 1:
        return f"at {labels[0]} 1/s²"
    if (np.diff(picked) > 1).any():
        return f"at {joined(labels)} 1/s²"
    if picked[0] == 0:
        return f"up to a stiffness of {labels[-1]} 1/s²"
    if picked[-1] == outcome.swept.stop - 1:
        return f"from {labels[0]} 1/s² on"
    return f"from {labels[0]} to {labels[-1]} 1/s²"


def _bias(outcome: Outcome) -> str:
    biased = outcome.is_biased[outcome.swept].any(axis=1)
    if not biased.any():
        return f"No bias of the first-order estimate is seen in the sweep ({outcome.settings.confidence:.0%} over all cases)."
    sentence = f"The first-order estimate is measurably biased {_range(outcome, biased)}"
    # No bias seen is no bias only where one of half the gradient's own size would have been seen.
    half_width = (outcome.bias.high - outcome.bias.low)[outcome.swept] / 2
    size = np.abs(outcome.reference.value[outcome.swept]).max(axis=0)
    is_blind = (half_width > size / 2).any(axis=1) & ~biased
    sentence += f"; {_range(outcome, is_blind)} it is too noisy to tell" if is_blind.any() else ""
    is_clean = ~biased & ~is_blind
    return sentence + (f"; {_range(outcome, is_clean)} no bias is seen." if is_clean.any() else ".")


def _default(outcome: Outcome) -> list[str]:
    if not outcome.has_default:
        return []
    biased, wrong = outcome.is_biased[-1].sum(), outcome.has_wrong_sign[-1].sum()
    count = len(outcome.angles)
    if not biased:
        return [f"Under MuJoCo's default contact no bias is seen at any of the {count} angles."]
    sign = f", and has the wrong sign at {wrong}" if wrong else ""
    return [f"Under MuJoCo's default contact it is biased at {biased} of {count} angles{sign}."]


def _worst_bias(outcome: Outcome) -> str | None:
    size = np.where(outcome.is_biased, np.abs(outcome.bias.value), -1.0)
    i, j = np.unravel_index(np.argmax(size), size.shape)
    if size[i, j] < 0:
        return None
    first, reference = outcome.first.value[i, j], outcome.reference.value[i, j]
    return (
        f"Largest bias: at {outcome.angles[j]:g} rad and stiffness {name(outcome, int(i))} the first-order mean is "
        f"{quantity(first)} where the truth is {quantity(reference)} m²/rad."
    )


def _wrong_signs(outcome: Outcome) -> str | None:
    count = int(outcome.has_wrong_sign.sum())
    if not count:
        return None
    cases = "one case" if count == 1 else f"{count} of {outcome.has_wrong_sign.size} cases"
    where = outcome.has_wrong_sign.any(axis=0)
    return f"The first-order estimate surely points the wrong way in {cases}, {_angles(outcome, where)}."


def _variance(outcome: Outcome) -> str | None:
    """Name the cases whose variances differ beyond their intervals."""
    larger = (outcome.first_variance.low > outcome.zeroth_variance.high)[outcome.swept].any(axis=1)
    if not larger.any():
        return "Nowhere in the sweep is the variance of first order beyond that of zeroth order."
    return f"The variance of first order exceeds that of zeroth order, at some angle, {_range(outcome, larger)}."
