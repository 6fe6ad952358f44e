"""The answer of an optimisation experiment, computed from its numbers, and its pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator
from scipy.stats import mannwhitneyu

from experiments.optimisation.measure import Difference, Outcome, Run
from experiments.report import MOST_WORDS, Bold, Table, tabulated
from experiments.theme import REFERENCE, Drawings, logarithmic, looks, panel, power, subplots
from experiments.words import capitalised, counted, percent, quantity

# A column in the page over a sweep.
_AGAINST = "α-order against the better"


def answer(outcome: Outcome) -> str:
    """Name the methods that end lowest and highest, and say where the seeds cannot tell the lowest from the next."""
    best = outcome.best
    others = [run for run in outcome.runs if run is not best and run.kept.size]
    lowest = f"{capitalised(best.method.label)} ends lowest"
    if not others or not best.kept.size:
        return f"{lowest}, at {quantity(best.mean, best.spread)}."
    second, highest = (choose(others, key=lambda run: run.mean) for choose in (min, max))
    is_proven = mannwhitneyu(best.kept, second.kept).pvalue <= 0.05
    doubt = "" if is_proven else f"; {counted(best.kept.size, 'seed', 'seeds')} cannot prove it"
    told = f"{lowest} ({quantity(best.mean)}{doubt})"
    whole = f"{told}, {highest.method.label} highest ({quantity(highest.mean)})."
    return whole if len(whole.split()) <= MOST_WORDS else f"{told}."


def verdict(outcome: Outcome) -> str:
    """Say whether α-order is worse than the better of first and zeroth order, and which method ends lowest."""
    best = outcome.best
    lowest = f"Lowest of all ends {best.method.label}, at {quantity(best.mean, best.spread)}."
    return " ".join([*map(_comparison, outcome.verdicts), lowest])


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
            parts.append(f"{percent(1 - run.finite_share)} of the rollouts were not finite and were left out")
        if parts:
            sentences.append(f"{run.method.label}: {'; '.join(parts)}.")
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all methods."""
    told = {outcome.best.method.label, *(one.ours.method.label for one in outcome.verdicts if one.is_above)}
    rows = []
    for run in outcome.runs:
        low, high = run.interval(outcome.settings.confidence)
        mean, spread = outcome.published(run) or (None, None)
        rows.append(
            {
                "method": run.method.label,
                "final cost": (Bold if run.method.label in told else str)(quantity(run.mean, run.spread)),
                f"{outcome.settings.confidence:.0%} interval of the mean": (
                    f"{quantity(low)} to {quantity(high)}" if low == low else ""
                ),
                "published": "" if mean is None else quantity(mean, spread if spread == spread else None),
                "lost runs": (Bold if run.is_lost.any() else str)(f"{run.is_lost.sum()} of {run.is_lost.size}"),
                "mean α": f"{np.nanmean(run.alpha):.3g}" if run.reasons else "",
                "rollouts per step": str(run.rollouts_per_step),
                "ms per step": f"{1e3 * run.seconds_per_step:.3g}",
                "compilation, s": f"{run.compile_seconds:.1f}",
            }
        )
    caption = (
        f"Cost without noise after {outcome.num_steps} steps, mean ± standard deviation over {outcome.settings.seeds} "
        f"seeds, from {quantity(outcome.start_cost)} at the start; {outcome.dim} parameters. Lost runs have no finite cost "
        "in the end; they are not in mean and interval. Bold is the lowest mean, and α-order if it is worse than the "
        "better of first and zeroth order. A step's time is that of one seed of all that run at once."
    )
    return [tabulated(rows, caption)]


def headline(outcome: Outcome) -> dict[str, str]:
    """Give the row of this run in the page over a sweep."""
    cells = {
        run.method.label: quantity(run.mean, run.spread) + (f" ({run.is_lost.sum()} lost)" if run.is_lost.any() else "")
        for run in outcome.runs
    }
    for difference in outcome.verdicts:
        kind = "worse" if difference.is_above else "better" if difference.is_below else "cannot be told"
        cells[_AGAINST] = f"{kind}: {_signed(difference)}"
    return cells


def together(summaries: Sequence[dict[str, Any]]) -> str | None:
    """Say of a sweep how often α-order ends worse and better than the better of first and zeroth order."""
    kinds = [summary["headline"].get(_AGAINST, "").partition(":")[0] for summary in summaries]
    if "" in kinds:
        return None
    worse, better = kinds.count("worse"), kinds.count("better")
    start = f"Worse on {worse} of {len(kinds)}" if worse else f"Never in {len(kinds)}"
    return f"{start}; better on {better}; seeds cannot tell on {len(kinds) - worse - better}."


def _comparison(difference: Difference) -> str:
    ours, other = difference.ours, difference.other
    if not (ours.kept.size and other.kept.size):
        return f"{ours.is_lost.sum()} runs of α-order and {other.is_lost.sum()} of {other.method.label} were lost."
    numbers = f"{_signed(difference)}, rank test p = {difference.p_value:.2g}"
    against = f"{other.method.label}, the better of first and zeroth order"
    lost = f", with {ours.is_lost.sum()} runs lost" if ours.is_lost.any() else ""
    if difference.is_above:
        # What speaks against it counts by the means alone, too.
        means = "" if difference.is_ranked or lost else " by the means alone"
        return f"α-order ends worse than {against}{means}{lost} ({numbers})."
    if difference.is_below:
        return f"α-order ends better than {against}{lost} ({numbers})."
    return f"{ours.kept.size} seeds cannot tell α-order from {against}{lost} ({numbers})."


def _signed(difference: Difference) -> str:
    """Write a difference with its interval."""
    ends = f"{quantity(difference.low)} to {quantity(difference.high)}"
    sign = "+" if difference.value > 0 else ""
    return f"{sign}{quantity(difference.value)}, {difference.confidence:.0%} interval {ends}"


# From the best to the worst cost, as a factor; beyond, differences near the best are seen on a logarithmic axis only.
_WIDE = 3.0

# Beyond the quartiles of the final costs by so many times their distance a method is far off.
_REACH = 6.0

_SENTENCES = {
    "inverse_variance": ("least variance", "#7fb8a6"),
    "bias_limit": ("bias limits it", "#e69f00"),
    "uncertain": ("too uncertain for first order", "#9db4d0"),
    "inconsistent": ("derivatives contradict costs", "#0b5c8f"),
    "not_finite": ("derivatives not finite", "#22262e"),
    "nothing_felt": ("nothing reaches the cost", "#6b2737"),
    "fixed": ("given", "#c9ced6"),
    "inside": ("within zeroth order's error", "#d9c27a"),
}
_DARK = ("inconsistent", "not_finite", "nothing_felt")


def drawings(outcome: Outcome) -> Drawings:
    """Draw the figures in order of reading."""
    found = {"final": final(outcome), "curves": curves(outcome)}
    has_alpha = any(run.reasons for run in outcome.runs)
    return found | ({"alpha": alpha(outcome)} if has_alpha else {})


def final(outcome: Outcome):
    """Final cost of every seed, a row for each method."""
    figure, left = panel(1.1 + 0.31 * len(outcome.runs))
    rows = np.arange(len(outcome.runs))[::-1]
    limit = _limit(outcome)
    for y, run in zip(rows, outcome.runs, strict=True):
        colour = _colours(outcome)[run.method.label]
        kept = run.kept
        # Spread out by number, not by chance: the same picture from the same numbers.
        left.plot(kept, y + np.linspace(-0.22, 0.22, kept.size), "o", ms=3.2, color=colour, alpha=0.45, mew=0)
        if kept.size > 1 and run.mean <= limit:
            low, high = run.interval(outcome.settings.confidence)
            left.plot([low, high], [y, y], color=colour, lw=2.4, solid_capstyle="butt")
        left.plot(run.mean, y, "|", color=colour, ms=13, mew=2.2)
        if (published := outcome.published(run)) is not None:
            spread = np.nan_to_num(published[1], posinf=0.0)
            left.errorbar(
                published[0], y - 0.33, xerr=spread, fmt="D", ms=4.5, mfc="white", mec=REFERENCE, ecolor=REFERENCE,
                elinewidth=1.0, capsize=2, zorder=5,
            )  # fmt: skip
        notes = [f"{run.is_lost.sum()} of {len(run.is_lost)} not finite"] if run.is_lost.any() else []
        notes += [f"{quantity(run.mean, run.spread)} →"] if run.mean > limit else []
        if notes:
            text = ", ".join(notes)
            left.text(0.99, y, text, transform=left.get_yaxis_transform(), ha="right", va="center", fontsize=8.5)
    left.set_yticks(rows, [run.method.label for run in outcome.runs])
    left.set_ylim(-0.6, len(rows) - 0.4)
    low = min([*(float(cost) for run in outcome.runs for cost in run.kept), limit])
    if limit > _WIDE * low > 0:
        left.set_xlim(low / 1.08, limit * 1.08)
        _log_scale(left)
    else:
        margin = 0.04 * (limit - low or 1.0)
        left.set_xlim(low - margin, limit + margin)
    left.set(title="Cost without noise after the last step", xlabel="cost")
    _mark_ours(left, outcome.runs)
    percent = f"{outcome.settings.confidence:.0%}"
    diamonds = "; diamonds are published means ± standard deviations" if outcome.reference else ""
    caption = (
        f"Dots are seeds, bars the means with their {percent} intervals{diamonds}. An arrow stands for a mean ± standard "
        "deviation beyond the panel."
    )
    return figure, "Where each method ends", caption


def curves(outcome: Outcome):
    """Cost without noise against what was spent, the median and the range over seeds."""
    descents, baselines = ([run for run in outcome.runs if run.method.is_baseline is kind] for kind in (False, True))
    # What one would otherwise use has α-order as it comes beside it.
    searches = [run for run in outcome.runs if run.method.is_default_alpha] + baselines if baselines else []
    groups = [group for group in (descents, searches) if group]
    figure, axes = subplots(len(groups), 2, height=3.7 * len(groups), sharey=True)
    lowest = _lowest(outcome)
    for row, group in zip(axes, groups, strict=True):
        for axis, spent in zip(row, ("rollouts", "seconds"), strict=True):
            for run in group:
                _curve(axis, outcome, run, getattr(run, spent))
            logarithmic(axis.yaxis)
            axis.yaxis.set_major_formatter(lambda value, _: power(value))
            axis.margins(x=0)
        row[0].set_ylabel(f"cost − {lowest:.4g}")
        row[1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8.5)
        row[0].xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}".replace(",", "\u2009"))
    axes[0, 0].set_title("Against rollouts")
    axes[0, 1].set_title("Against time")
    axes[-1, 0].set_xlabel("rollouts of one run")
    axes[-1, 1].set_xlabel(f"seconds for all {outcome.settings.seeds} runs, without compilation")
    # A run that climbs by decades, or one that is the lowest itself, would flatten all others.
    above = outcome.start_cost - lowest
    medians = [float(np.nanmin(np.nanmedian(run.cost, axis=0))) for run in outcome.runs if run.kept.size]
    smallest = min(medians, default=outcome.start_cost) - lowest
    axes[0, 0].set_ylim(max(_floor(outcome), 0.5 * smallest), 1.5 * above)
    caption = (
        f"Lines are medians over {outcome.settings.seeds} seeds; bands, of α-order and of what ends lowest, reach from the "
        "lowest seed to the highest. The axis is the cost above the lowest that any run has met, so a line that ends low on the "
        "logarithmic scale is as good as the best; below, what one would otherwise use, with α-order for comparison. Both "
        "columns are of the same runs; the seconds include the measurement of the noise-free cost, which is no rollout of the "
        "method."
    )
    return figure, "Cost against rollouts and against time", caption


def alpha(outcome: Outcome):
    """α over steps, and the share of steps for each reason."""
    runs = [run for run in outcome.runs if run.reasons]
    figure, axes = subplots(1, 2, height=2.2 + 0.42 * len(runs), gridspec_kw={"width_ratios": [1.25, 1]})
    left, right = axes[0]
    for run in runs:
        colour = _colours(outcome)[run.method.label]
        middle = np.nanmean(run.alpha, axis=0)
        # Averaged over a fiftieth of the steps, so that the lines do not hide each other.
        width = max(1, middle.size // 50)
        middle = np.convolve(middle, np.ones(width) / width, mode="valid")
        left.plot(np.arange(middle.size), middle, color=colour, lw=1.8, label=run.method.label)
    left.set(title="Mean α over seeds", xlabel="step", ylim=(-0.04, 1.04), ylabel="α")
    left.margins(x=0)
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, fontsize=8.5)
    rows = np.arange(len(runs))[::-1]
    starts = np.zeros(len(runs))
    totals = np.array([max((~np.isnan(run.alpha)).sum(), 1) for run in runs])
    for name, (text, colour) in _SENTENCES.items():
        shares = np.array([run.reasons[name].sum() if name in run.reasons else 0 for run in runs]) / totals
        if shares.any():
            right.barh(rows, shares, left=starts, color=colour, height=0.6, label=text)
            ink = "white" if name in _DARK else REFERENCE
            for y, start, share in zip(rows, starts, shares, strict=True):
                if share >= 0.08:
                    right.text(start + share / 2, y, f"{share:.0%}", ha="center", va="center", fontsize=8, color=ink)
        starts += shares
    right.set_yticks(rows, [run.method.label for run in runs])
    _mark_ours(right, runs)
    right.set(title="Share of steps by the reason for α", xlim=(0, 1))
    right.xaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    right.grid(visible=False, axis="y")
    right.legend(loc="upper center", bbox_to_anchor=(0.4, -0.2), ncols=2, fontsize=8.5)
    caption = (
        "Left, the weight of the first-order part: the mean over seeds and blocks of parameters, smoothed over a fiftieth of the "
        "steps. Right, how often each reason settled it."
    )
    return figure, "The weight of the first-order part", caption


def _curve(axis: Axes, outcome: Outcome, run: Run, x: np.ndarray) -> None:
    colour = _colours(outcome)[run.method.label]
    cost = np.maximum(np.where(np.isfinite(run.cost), run.cost, np.nan) - _lowest(outcome), _floor(outcome))
    seen = np.isfinite(cost).any(axis=0)
    x, cost = x[seen], cost[:, seen]
    # Bands of all methods would hide each other, and the lines with them.
    if run is outcome.best or run.method.is_default_alpha:
        axis.fill_between(x, np.nanmin(cost, axis=0), np.nanmax(cost, axis=0), color=colour, alpha=0.16, lw=0)
    # Ours is a broad line beneath the others, so that those it agrees with are seen on it.
    width, order = (3.4, 2.5) if run.method.is_default_alpha else (1.4, 3.0)
    axis.plot(x, np.nanmedian(cost, axis=0), color=colour, lw=width, label=run.method.label, zorder=order)


def _mark_ours(axis: Axes, runs: Sequence[Run]) -> None:
    for label, run in zip(axis.get_yticklabels(), runs, strict=True):
        if run.method.is_default_alpha:
            label.set_fontweight("bold")


def _limit(outcome: Outcome) -> float:
    """Give the highest final cost to show: methods that fail would set the scale, and hide how the others differ."""
    shown = [float(cost) for run in outcome.runs if not run.method.is_baseline for cost in run.kept]
    shown += [found[0] for run in outcome.runs if (found := outcome.published(run)) is not None]
    if not shown:
        return outcome.start_cost
    low, high = np.quantile(shown, [0.25, 0.75])
    return float(min(max(shown), high + _REACH * (high - low)))


def _lowest(outcome: Outcome) -> float:
    """Give the lowest cost that any run has seen."""
    return min([outcome.start_cost, *(float(np.min(run.cost)) for run in outcome.runs)])


def _floor(outcome: Outcome) -> float:
    """Give what stands for zero on a logarithmic axis."""
    return 1e-5 * (outcome.start_cost - _lowest(outcome)) or 1.0


def _log_scale(axis: Axes) -> None:
    logarithmic(axis.xaxis)
    low, high = axis.xaxis.get_view_interval()
    subs = (1.0,) if high > 30 * low else (1.0, 2.0, 5.0)
    axis.xaxis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.xaxis.set_major_formatter(lambda value, _: power(value))


def _colours(outcome: Outcome) -> dict[str, str]:
    labels = [run.method.label for run in outcome.runs]
    return {label: look["color"] for label, look in zip(labels, looks(labels), strict=True)}
