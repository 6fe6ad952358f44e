"""The pictures of an experiment on a textbook problem."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from experiments.textbook.outcome import Outcome
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, power, shades, subplots
from mjxgrad.diagnostics import Comparison

# For further estimators, in the order of the settings; told apart by their markers, too.
_OTHERS = ("#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#6b6ecf", "#8b94a1", "#393b79")
_MARKERS = "osD^vP*X<>"


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    found: dict[str, Any] = {"problem": problem, "samples": samples}
    found |= {"stiffness": stiffness} if outcome.by_stiffness else {}
    return found | ({"missing": missing} if outcome.missing is not None else {})


def stiffness_name(outcome: Outcome) -> str:
    """Name the axis of stiffness."""
    return "frequency ω" if outcome.settings.problem == "quadratic_sine" else "stiffness 1/ν"


def problem(outcome: Outcome):
    """The cost with and without noise, and both gradients that estimates can converge to."""
    figure, axes = subplots(1, 2, height=3.3)
    curves, settings = outcome.curves, outcome.settings
    left, right = axes[0]
    left.plot(curves.grid, curves.cost, color=MUTED, lw=1.2, label="without noise")
    left.plot(curves.grid, curves.smoothed, color=REFERENCE, label=f"mean under noise of {settings.stddev:g}")
    left.set(title="Cost", xlabel="parameter")
    right.plot(curves.grid, curves.gradient, color=REFERENCE, label="gradient of the mean")
    right.plot(curves.grid, curves.first_order_mean, color=FIRST, ls=(0, (4, 2)), label="mean of first order", zorder=3)
    right.set(title="Gradient", xlabel="parameter")
    for axis in axes[0]:
        axis.axvline(settings.point, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        axis.set_xlim(curves.grid[0], curves.grid[-1])
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.22 * (high - low))
        axis.legend(loc="upper left", ncols=2)
    shown = "" if settings.shown_stiffness is None else f" at stiffness {settings.shown_stiffness:g}"
    caption = (
        f"Left, the cost{shown}; right, the gradient that is to be estimated, and what first order converges to. Where the "
        "two part, first order is biased. The dotted line marks the point of the estimates below."
    )
    return figure, "The cost and its gradient", caption


def samples(outcome: Outcome):
    """Root-mean-square error and bias against rollouts."""
    figure, axes = subplots(1, 2, height=4.2)
    x = np.asarray(outcome.settings.num_samples, float)
    left, right = axes[0]
    _errors(left, outcome, x, outcome.by_samples, outcome.exact_by_samples)
    left.set(title="Root-mean-square error", xlabel="rollouts per estimate", ylabel="error of the gradient")
    right.axhline(0, color=MUTED, lw=0.8)
    right.axhline(-1, color=MUTED, lw=0.8, ls=(0, (2, 3)))
    size = abs(outcome.gradient)
    for row, (colour, marker, shift) in enumerate(_looks(outcome)):
        bias = np.array([table.bias[row, 0] for table in outcome.by_samples]) / size
        ends = np.array([table.bias_interval[:, row, 0] for table in outcome.by_samples]).T / size
        _bars(right, x * shift, bias, ends, colour, marker, outcome.labels[row], is_line=False)
    right.set_xscale("log")
    right.set(title="Bias, as a share of the gradient", xlabel="rollouts per estimate")
    # One wild interval of few samples is not to flatten all others.
    seen = np.array([table.bias[:, 0] for table in outcome.by_samples[1:]]) / size
    reach = max(0.15, 1.6 * np.abs(seen).max())
    right.set_ylim(-reach, reach)
    _ticks(right, x)
    _ticks(left, x)
    _legend(figure, left)
    settings = outcome.settings
    percent = f"{settings.confidence:.0%}"
    repeats = f"Each mark is from {settings.num_repeats} estimates, with its {percent} interval"
    caption = (
        f"{repeats}. Left, distance to the true gradient; thin lines are closed forms, dotted ones join marks that have none. "
        "Right, mean less truth; at −1 (dotted) an estimate is zero throughout. A budget counts every rollout, that without "
        "noise included. Intervals that leave the panel are cut."
    )
    return figure, "Error against rollouts", caption


def stiffness(outcome: Outcome):
    """Root-mean-square error, absolute and relative, against stiffness."""
    figure, axes = subplots(1, 2, height=4.2)
    x = np.asarray(outcome.settings.stiffness)
    left, right = axes[0]
    _errors(left, outcome, x, outcome.by_stiffness, outcome.exact_by_stiffness)
    left.set(title="Root-mean-square error", ylabel="error of the gradient")
    count = outcome.settings.samples_at_stiffness
    for row, (colour, marker, shift) in enumerate(_looks(outcome)):
        variance = np.array([table.variance[row] for table in outcome.by_stiffness]) * count
        ends = np.array([table.variance_interval[:, row] for table in outcome.by_stiffness]).T * count
        _bars(right, x * shift, variance, ends, colour, marker, outcome.labels[row])
    right.set_xscale("log")
    right.set_yscale("log")
    right.set_title("Variance, per rollout")
    for axis in axes[0]:
        axis.set_xlabel(stiffness_name(outcome))
        _ticks(axis, x)
    _legend(figure, left)
    settings = outcome.settings
    percent = f"{settings.confidence:.0%}"
    repeats = f"Each mark is from {settings.num_repeats} estimates, with its {percent} interval"
    caption = (
        f"{repeats}, {settings.samples_at_stiffness} rollouts each. Left, distance to the true gradient; thin lines are "
        "closed forms. Right, variance of the estimate times rollouts. An estimate that never varies, because all its samples "
        "miss, has no mark there."
    )
    return figure, "Error against stiffness", caption


def missing(outcome: Outcome):
    """Chance that N samples all miss the slope, and the variance that this implies."""
    assert outcome.missing is not None
    figure, axes = subplots(1, 2, height=4.0)
    left, right = axes[0]
    found, x = outcome.missing.found, np.asarray(outcome.settings.stiffness)
    counts = outcome.missing.counts
    grid = np.geomspace(counts[0], counts[-1], 200)
    for i, colour in enumerate(shades(len(x))):
        p = outcome.missing.probability[i]
        left.plot(grid, (1 - p) ** grid, color=colour, lw=1.3, label=power(x[i]))
        left.plot(counts, outcome.missing.frequency[i], ".", color=colour, ms=4)
        if p > 0.5:
            continue  # most samples are on the slope, so that the event is to be on it
        # Where half of the sets miss, and so the interval is widest; bands of all stiffnesses would hide each other.
        at = np.clip(np.log(0.5) / np.log1p(-p), counts[0], counts[-1])
        low, high = found[i].miss_probability_interval(at)
        middle = found[i].miss_probability(at)
        left.errorbar(
            at, middle, [[middle - low], [high - middle]], color=colour, marker="D", ms=5, capsize=3, mec="white"
        )
    left.set_xscale("log")
    left.set(title="Chance that all samples miss", xlabel="samples N", ylim=(-0.03, 1.03))
    _ticks(left, np.array([2.0, 10.0, 100.0, 1000.0]))
    left.legend(
        title=stiffness_name(outcome), fontsize=8, title_fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0)
    )
    p = outcome.missing.probability
    right.plot(x, (2 * x) ** 2 * p * (1 - p), color=REFERENCE, label="variance of a sample, closed form")
    right.plot(x, [one.variance or np.nan for one in found], "o", color=FIRST, ms=5, label="as the samples show it")
    right.plot(
        x, [one.implied_variance_bound or np.nan for one in found], "_", color=ZEROTH, ms=11, mew=2,
        label="at least, from Δ and the bound of β",
    )  # fmt: skip
    unseen = np.array([one.num_outlying == 0 for one in found])
    for stiff in x[unseen]:
        right.axvspan(stiff / 1.25, stiff * 1.25, color=MUTED, alpha=0.15, lw=0)
    right.set_xscale("log")
    right.set_yscale("log")
    right.set(title="Variance of first order", xlabel=stiffness_name(outcome))
    right.legend(loc="lower right")
    _ticks(right, x)
    settings = outcome.settings
    percent = f"{settings.confidence:.0%}"
    caption = (
        "Left, for each stiffness: line, the closed form (1 − β)ᴺ; dots, how often N simulated samples all missed; diamonds, "
        f"what {settings.missed_samples} first-order samples tell, with its {percent} interval. Right, the variance of a "
        "sample of first order, as the same samples show it, and the least that the discrepancy between them and the gradient "
        "implies; shaded where no sample hit the slope, so that they show none."
    )
    return figure, "How often samples miss the slope", caption


def _errors(axis: Axes, outcome: Outcome, x: np.ndarray, tables: list[Comparison], exact: dict) -> None:
    """Draw measured errors with intervals and, thin, the closed forms."""
    for row, (colour, marker, shift) in enumerate(_looks(outcome)):
        label = outcome.labels[row]
        values = np.array([table.rmse[row] for table in tables])
        ends = np.array([table.rmse_interval[:, row] for table in tables]).T
        _bars(axis, x * shift, values, ends, colour, marker, label, is_line=label not in exact)
        if label in exact:
            axis.plot(x * shift, exact[label], color=colour, lw=1.0)
    axis.set_xscale("log")
    axis.set_yscale("log")
    # Errors often span a single decade, where powers of ten alone would leave one label.
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_locator(NullLocator())


def _bars(axis: Axes, x, value, ends, colour, marker, label, *, is_line: bool = True) -> None:
    # An end may lie beyond its value by rounding alone.
    errors = np.maximum([value - ends[0], ends[1] - value], 0)
    line = (0, (1, 2)) if is_line else ""
    axis.errorbar(
        x, value, errors, color=colour, marker=marker, ms=4.5, ls=line, lw=1.0, elinewidth=1.1, capsize=2, label=label
    )


def _looks(outcome: Outcome) -> list[tuple[str, str, float]]:
    """Colour, marker and sideways shift of each estimator; first and zeroth order have theirs everywhere."""
    fixed = {"first order": FIRST, "zeroth order": ZEROTH}
    others = iter(_OTHERS)
    count = len(outcome.labels)
    return [
        (fixed.get(label) or next(others), _MARKERS[row], 1.035 ** (row - (count - 1) / 2))
        for row, label in enumerate(outcome.labels)
    ]


def _ticks(axis: Axes, values: np.ndarray, most: int = 8) -> None:
    shown = values[:: -(-len(values) // most)]
    axis.set_xticks(shown, [power(value) for value in shown])
    axis.minorticks_off()


def _legend(figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)), fontsize=8.5)
