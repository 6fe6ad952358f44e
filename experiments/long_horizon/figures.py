"""The pictures of an experiment on long horizons."""

import numpy as np
from matplotlib.ticker import NullLocator

from experiments.long_horizon.outcome import ZEROTH, Errors, Outcome
from experiments.theme import FIRST, MUTED, REFERENCE, Drawings, subplots
from experiments.theme import ZEROTH as BLUE
from experiments.words import capitalised

_EVENT, _ONSET = "#cc79a7", "#009e73"
COLOURS = {"first order, discrete": FIRST, "first order, event": _EVENT, "first order, onset": _ONSET, ZEROTH: BLUE}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"errors": errors, "growth": growth, "windows": windows}


def errors(outcome: Outcome):
    """Relative error with its interval, bias where it is beyond chance, and variance; one column per problem."""
    figure, axes = subplots(2, len(outcome.found), height=6.4, sharex="col")
    for column, one in enumerate(outcome.found.values()):
        upper, lower = axes[:, column]
        for each in one.estimators:
            colour = COLOURS[each.label]
            upper.plot(one.times, each.error, color=colour, label=each.label)
            upper.fill_between(one.times, *each.interval, color=colour, alpha=0.15, lw=0)
            _draw_bias(upper, one.times, each, colour)
            lower.plot(one.times, each.variance, color=colour, label=each.label)
        for label, crossing in one.crossovers.items():
            if np.isfinite(crossing.horizon):
                high = min(crossing.high, one.times[-1])
                upper.axvspan(crossing.low, high, color=COLOURS[label], alpha=0.12, lw=0)
                upper.axvline(crossing.horizon, color=COLOURS[label], lw=0.9, ls=(0, (2, 2)))
        upper.set(yscale="log", title=capitalised(one.title))
        lower.set(yscale="log", xlabel="horizon, s")
    axes[0, 0].set_ylabel("error over the largest gradient")
    axes[1, 0].set_ylabel("variance of one sample, m²")
    handles, labels = axes[0, -1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8.5)
    sizes, confidence = outcome.settings.sizes, outcome.settings.confidence
    caption = (
        f"Gradient of the mean cost at the horizon by the policy's noisy parameters, from {sizes.num_samples} rollouts. "
        f"Lines: root mean squared error over {sizes.num_repeats} repeats, over the largest gradient of all horizons; bands: "
        f"{confidence:.0%}. Circles: bias, where it is beyond chance. Dashed: horizon from which on zeroth order is as good, "
        "with its interval. Below: variance of one rollout's gradient, summed over parameters."
    )
    return figure, "Error, bias and variance against the horizon", caption


def _draw_bias(axis, times: np.ndarray, each: Errors, colour: str) -> None:
    is_seen = each.bias > each.bias_noise
    axis.plot(times[is_seen], each.bias[is_seen], "o", color=colour, ms=4, mfc="none", mew=1.1)


def growth(outcome: Outcome):
    """Logarithm of the largest singular value, rollout by rollout, with the variance's growth; exponents beside."""
    count = len(outcome.found)
    figure, axes = subplots(1, count + 1, height=3.8)
    for axis, one in zip(axes[0], outcome.found.values(), strict=False):
        axis.plot(one.times, one.log_largest.T, color=MUTED, lw=0.7, alpha=0.6)
        axis.plot(one.times, np.median(one.log_largest, axis=0), color=REFERENCE, lw=2, label="largest singular value")
        for each in one.estimators[:-1]:
            logs = np.log(each.variance) / 2
            shift = np.median(one.log_largest, axis=0)[len(logs) // 2 :].mean() - logs[len(logs) // 2 :].mean()
            axis.plot(
                one.times, logs + shift, color=COLOURS[each.label], lw=1.2, label=f"√variance, {each.label}, shifted"
            )
        axis.set(title=capitalised(one.title), xlabel="time, s")
        axis.legend(fontsize=7.5)
    axes[0, 0].set_ylabel("logarithm")
    last = axes[0, -1]
    adaptive = outcome.adaptive
    if adaptive is None:
        for one in outcome.found.values():
            last.plot(one.times, one.exponents, lw=1.2)
        last.set(title="Finite-time Lyapunov exponents, 1/s", xlabel="time, s")
    else:
        last.plot(adaptive.times, adaptive.stepped, color=REFERENCE, label="steps: largest singular value")
        last.plot(adaptive.times, adaptive.log_largest, "o", color=BLUE, ms=4, label="error control: the same")
        last.plot(
            adaptive.times,
            np.log(adaptive.apart),
            "s-",
            color=FIRST,
            ms=3,
            lw=1,
            label="steps less error control, over it",
        )
        last.set(title="The pendulum's steps and its motion", xlabel="time, s")
        last.legend(fontsize=7.5)
    caption = (
        "Grey: logarithm of the largest singular value of the product of all steps' Jacobians, rollout by rollout; black, its "
        "median. Half the logarithm of the estimate's variance runs along with it. With the pendulum, both are held against "
        "integration with error control: where the steps' distance from it nears one the steps are another motion."
    )
    return figure, "Why: the product of the Jacobians", caption


def windows(outcome: Outcome):
    """Error and bias against the window's length."""
    figure, axes = subplots(1, len(outcome.found), height=3.9, sharey=True)
    for axis, one in zip(axes[0], outcome.found.values(), strict=True):
        length = one.times[0] * np.array(next(iter(one.windows.values())).lengths)
        for label, cut in one.windows.items():
            for kind, (style, name) in enumerate((((0, (2, 2)), "cut"), ("-", "with a value function"))):
                error, interval = cut.error[kind], cut.interval[kind]
                axis.plot(length, error, color=COLOURS[label], ls=style, marker=".", label=f"{label}, {name}")
                axis.fill_between(length, *interval, color=COLOURS[label], alpha=0.12, lw=0)
                is_seen = cut.bias[kind] > cut.bias_noise[kind]
                axis.plot(
                    length[is_seen], cut.bias[kind][is_seen], "o", color=COLOURS[label], mfc="none", ms=5, mew=1.1
                )
        error, low, high = next(iter(one.windows.values())).zeroth
        axis.axhline(error, color=BLUE, lw=1.2, label=ZEROTH)
        axis.axhspan(low, high, color=BLUE, alpha=0.12, lw=0)
        axis.set(xscale="log", yscale="log", title=capitalised(one.title), xlabel="length of a window, s")
        axis.set_xticks(length, [f"{seconds:.2g}" for seconds in length])
        axis.xaxis.set_minor_locator(NullLocator())
    axes[0, 0].set_ylabel("error over the gradient")
    handles, labels = axes[0, -1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8.5)
    caption = (
        "Gradient of the cost's mean over the whole horizon, when derivatives are cut after a window: plain, and with the "
        "value of what comes after, fitted by a quadratic. Circles: bias beyond chance. The rightmost window is the whole "
        "horizon. A short window has bias in place of variance."
    )
    return figure, "Windows, plain and with a value function", caption
