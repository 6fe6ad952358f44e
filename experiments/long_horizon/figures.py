"""The pictures of an experiment on long horizons."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from experiments.long_horizon.measure import CUT, ZEROTH, Errors, Outcome
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, REFERENCE, Drawings, legend_below, subplots
from experiments.theme import ZEROTH as BLUE
from experiments.words import capitalised

COLOURS = {
    "first order, discrete": FIRST,
    "first order, event": DEFAULT,
    "first order, onset": ONSET,
    ZEROTH: BLUE,
}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"errors": errors, "growth": growth, "windows": windows}


def errors(outcome: Outcome):
    """Relative error with its interval, bias where it is beyond chance, and variance; one column per problem."""
    figure, axes = subplots(2, len(outcome.found), height=6.4, sharex="col")
    for (upper, lower), one in zip(axes.T, outcome.found.values(), strict=True):
        for label, each in one.errors.items():
            _draw_errors(upper, one.times, each, color=COLOURS[label], label=label)
            lower.plot(one.times, each.variance, color=COLOURS[label])
        for label, crossing in one.crossovers.items():
            if np.isfinite(crossing.horizon):
                high = min(crossing.high, one.times[-1])
                upper.axvspan(crossing.low, high, color=COLOURS[label], alpha=0.12, lw=0)
                upper.axvline(crossing.horizon, color=COLOURS[label], lw=0.9, ls=(0, (2, 2)))
        upper.set(yscale="log", title=capitalised(one.title))
        lower.set(yscale="log", xlabel="horizon, s")
    axes[0, 0].set_ylabel("error over the largest gradient")
    axes[1, 0].set_ylabel("variance of one sample, m²")
    legend_below(figure, axes[0, -1], len(COLOURS))
    sizes, confidence = outcome.settings.sizes, outcome.settings.confidence
    caption = (
        f"Gradient of the mean cost at the horizon by the policy's noisy parameters, from {sizes.num_samples} rollouts: root "
        f"mean squared error over {sizes.num_repeats} repeats, over the largest gradient of all horizons, with "
        f"{confidence:.0%} bands. Circles: bias beyond chance. Dashed: from there on zeroth order is as good, with its "
        "interval. Below: variance of one rollout's gradient, summed over parameters."
    )
    return figure, "Error, bias and variance against the horizon", caption


def _draw_errors(axis: Axes, places: np.ndarray, each: Errors, *, color: str, **look) -> None:
    """Draw a line with its band, and circles where the bias is beyond chance."""
    axis.plot(places, each.error, color=color, **look)
    axis.fill_between(places, *each.interval, color=color, alpha=0.13, lw=0)
    is_seen = each.bias > each.bias_noise
    axis.plot(places[is_seen], each.bias[is_seen], "o", color=color, ms=4.5, mfc="none", mew=1.1)


def growth(outcome: Outcome):
    """Logarithm of the largest singular value, rollout by rollout, with the variance's growth; exponents beside."""
    figure, axes = subplots(1, len(outcome.found) + 1, height=3.8)
    for axis, one in zip(axes[0], outcome.found.values(), strict=False):
        median = np.median(one.log_largest, axis=0)
        axis.plot(one.times, one.log_largest.T, color=MUTED, lw=0.7, alpha=0.6)
        axis.plot(one.times, median, color=REFERENCE, lw=2, label="largest singular value")
        for label in one.crossovers:
            logs = np.log(one.errors[label].variance) / 2
            shift = (median - logs)[len(logs) // 2 :].mean()
            axis.plot(one.times, logs + shift, color=COLOURS[label], lw=1.2, label=f"√variance, {label}, shifted")
        axis.set(title=capitalised(one.title), xlabel="time, s")
        axis.legend(fontsize=7.5)
    axes[0, 0].set_ylabel("logarithm")
    last, adaptive = axes[0, -1], outcome.adaptive
    if adaptive is None:
        for one in outcome.found.values():
            last.plot(one.times, one.exponents, lw=1.2)
        last.set(title="Finite-time Lyapunov exponents, 1/s", xlabel="time, s")
    else:
        last.plot(adaptive.times, adaptive.stepped, color=REFERENCE, label="steps: largest singular value")
        last.plot(adaptive.times, adaptive.log_largest, "o", color=BLUE, ms=4, label="error control: the same")
        apart = np.log(adaptive.apart)
        last.plot(adaptive.times, apart, "s-", color=FIRST, ms=3, lw=1, label="steps less error control, over it")
        last.set(title="The pendulum's steps and its motion", xlabel="time, s")
        last.legend(fontsize=7.5)
    caption = (
        "Grey: logarithm of the largest singular value of the product of all steps' Jacobians, rollout by rollout; black, "
        "its median. Half the logarithm of the estimate's variance runs along with it. The pendulum's are held against "
        "integration with error control: where the steps' distance from it nears one they are another motion."
    )
    return figure, "Why: the product of the Jacobians", caption


def windows(outcome: Outcome):
    """Error and bias against the window's length."""
    figure, axes = subplots(1, len(outcome.found), height=3.9, sharey=True)
    for axis, one in zip(axes[0], outcome.found.values(), strict=True):
        found = one.windows
        for (label, kind), each in found.errors.items():
            style = (0, (2, 2)) if kind == CUT else "-"
            _draw_errors(
                axis, found.lengths, each, color=COLOURS[label], ls=style, marker=".", label=f"{label}, {kind}"
            )
        axis.axhline(found.zeroth.error[0], color=BLUE, lw=1.2, label=ZEROTH)
        axis.axhspan(*found.zeroth.interval[:, 0], color=BLUE, alpha=0.12, lw=0)
        axis.set(xscale="log", yscale="log", title=capitalised(one.title), xlabel="length of a window, s")
        axis.set_xticks(found.lengths, [f"{seconds:.2g}" for seconds in found.lengths])
        axis.xaxis.set_minor_locator(NullLocator())
    axes[0, 0].set_ylabel("error over the gradient")
    legend_below(figure, axes[0, -1], 3)
    caption = (
        "Gradient of the cost's mean over the whole horizon, when derivatives are cut after a window: plain, and with the "
        "value of what comes after, fitted by a quadratic. Circles: bias beyond chance. The rightmost window is the whole "
        "horizon."
    )
    return figure, "Windows, plain and with a value function", caption
