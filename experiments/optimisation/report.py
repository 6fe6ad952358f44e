"""The answer of an optimisation experiment in words, computed from its numbers."""

import numpy as np

from experiments.optimisation.outcome import Difference, Outcome
from experiments.report import Table
from experiments.words import quantity

# A published standard deviation is of 2 to 5 seeds; within three of both there is no telling them apart.
_AGREEMENT = 3.0


def verdict(outcome: Outcome) -> str:
    """Say whether α-order is worse than the better of first and zeroth order, and which method ends lowest."""
    best = outcome.best
    lowest = f"Lowest of all ends {best.method.label}, at {quantity(best.mean, best.spread)}."
    return " ".join([*map(_comparison, outcome.verdicts), lowest])


def findings(outcome: Outcome) -> list[str]:
    """Compare with what was published, within the spreads of both."""
    pairs = [(run, found) for run in outcome.runs if (found := outcome.published(run)) is not None and run.kept.size]
    if not pairs:
        return []
    apart = []
    for run, (mean, spread) in pairs:
        width = np.hypot(np.nan_to_num(run.spread), np.nan_to_num(spread))
        # Published to three or four digits.
        if abs(run.mean - mean) > _AGREEMENT * width + 1e-3 * abs(mean):
            apart.append(f"{run.method.label} ({run.mean:.4g}, published {mean:.4g})")
    agreeing = f"{len(pairs) - len(apart)} of {len(pairs)} published results are met within three standard deviations"
    return [f"{agreeing}; apart: {', '.join(apart)}." if apart else f"{agreeing}."]


def warnings(outcome: Outcome) -> list[str]:
    """Say what was lost or left out."""
    sentences = []
    for run in outcome.runs:
        parts = []
        if run.is_lost.any():
            parts.append(f"{run.is_lost.sum()} of {run.is_lost.size} runs ended without a finite cost")
        if run.num_skipped.any():
            parts.append(f"{run.num_skipped.sum()} steps were not taken, because the estimate was not finite")
        if run.finite_share < 1:
            parts.append(f"{1 - run.finite_share:.2%} of the rollouts were not finite and were left out")
        if parts:
            sentences.append(f"{run.method.label}: {'; '.join(parts)}.")
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all methods."""
    worse = {difference.ours.method.label for difference in outcome.verdicts if difference.is_above}
    rows, emphasised = [], set()
    for i, run in enumerate(outcome.runs):
        if run.method.label in worse or run.method.label == outcome.best.method.label:
            emphasised.add((i, 1))
        if run.is_lost.any():
            emphasised.add((i, 4))
        low, high = run.interval(outcome.settings.confidence)
        error, published = outcome.relative_error(run), outcome.published(run)
        rows.append(
            [
                run.method.label,
                quantity(run.mean, run.spread),
                f"{quantity(low)} to {quantity(high)}" if low == low else "",
                ""
                if published is None
                else quantity(published[0], published[1] if np.isfinite(published[1]) else None),
                f"{run.is_lost.sum()} of {run.is_lost.size}",
                "" if error is None else quantity(error[0], (error[2] - error[1]) / 2),
                f"{np.nanmean(run.alpha):.3g}" if run.reasons else "",
                str(run.rollouts_per_step),
                f"{1e3 * run.seconds_per_step:.3g}",
                f"{run.compile_seconds:.1f}",
            ]
        )
    percent = f"{outcome.settings.confidence:.0%}"
    columns = (
        "method", "final cost", f"{percent} interval of the mean", "published", "lost runs", "relative error",
        "mean α", "rollouts per step", "ms per step", "compilation, s",
    )  # fmt: skip
    caption = (
        f"Cost without noise after {outcome.num_steps} steps, mean ± standard deviation over {outcome.settings.seeds} "
        f"seeds, from {quantity(outcome.start_cost)} at the start; {outcome.dim} parameters. Lost runs have no finite cost "
        "in the end; they are not in mean and interval. Bold is the lowest mean, and α-order if it is worse than the "
        "better of first and zeroth order. The error is that of one estimate at the start. A step's time is that of one "
        "seed of all that run at once."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def headline(outcome: Outcome) -> dict[str, str]:
    """Give the row of this run in the page over a sweep."""
    cells = {
        run.method.label: quantity(run.mean, run.spread) + (f" ({run.is_lost.sum()} lost)" if run.is_lost.any() else "")
        for run in outcome.runs
    }
    for difference in outcome.verdicts:
        kind = "worse" if difference.is_above else "better" if difference.is_below else "no difference"
        cells["α-order against the better"] = f"{kind}: {_signed(difference)}"
    return cells


def _comparison(difference: Difference) -> str:
    ours, other = difference.ours, difference.other
    if not (ours.kept.size and other.kept.size):
        return f"{ours.is_lost.sum()} runs of α-order and {other.is_lost.sum()} of {other.method.label} were lost."
    kind = "ends worse" if difference.is_above else "ends better" if difference.is_below else "is not worse"
    noise = "" if difference.is_above or difference.is_below else ", beyond seed noise"
    lost = f", with {ours.is_lost.sum()} runs lost" if ours.is_lost.any() else ""
    return (
        f"α-order {kind} than {other.method.label}, the better of first and zeroth order{noise}{lost} "
        f"({_signed(difference)}, rank test p = {difference.p_value:.2g})."
    )


def _signed(difference: Difference) -> str:
    """Write a difference with its interval."""
    ends = f"{quantity(difference.low)} to {quantity(difference.high)}"
    sign = "+" if difference.value > 0 else ""
    return f"{sign}{quantity(difference.value)}, {difference.confidence:.0%} interval {ends}"
