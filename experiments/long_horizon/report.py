"""The answer of an experiment on long horizons: words, tables, pictures."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from experiments.long_horizon.measure import CUT, VALUED, ZEROTH, Errors, Found, Outcome
from experiments.report import Table
from experiments.theme import DEFAULT, FIRST, MUTED, ONSET, REFERENCE, Drawings, legend_below, power, subplots
from experiments.theme import ZEROTH as BLUE
from experiments.words import capitalised, joined, percent, quantity


def answer(outcome: Outcome) -> str:
    """Say up to which horizon the best first-order estimate is better, and where windows help."""
    found = outcome.found.values()
    limits = ", ".join(f"{_limit(one)} ({one.title})" for one in found)
    helped = [one.title for one in found if _window_helps(one)]
    if len(found) == 1:
        return f"Better {limits}; windows {'help' if helped else 'do not help'}."
    where = "everywhere" if len(helped) == len(found) else f"the {joined(helped)}" if helped else "nowhere"
    return f"Better {limits}; windows help {where}."


def _limit(one: Found) -> str:
    """Say up to which horizon the best of the first-order estimates is ahead."""
    longest = max(crossing.horizon for crossing in one.crossovers.values())
    if longest == one.times[0]:
        return "nowhere"
    return f"to {longest:.2g} s" if np.isfinite(longest) else f"beyond {one.times[-1]:.2g} s"


def _window_helps(one: Found) -> bool:
    """Say whether some window is closer than zeroth order and than the whole horizon."""
    cuts = one.windows.errors.values()
    whole = min(errors.error[-1] for errors in cuts)
    return bool(min(errors.error[:-1].min() for errors in cuts) < min(whole, one.windows.zeroth.error[0]))


def verdict(outcome: Outcome) -> str:
    """Say up to which horizon first order is better, and what to do beyond."""
    crossings = [_crossing(outcome, one) for one in outcome.found.values()]
    windows = "; ".join(_window(one) for one in outcome.found.values())
    return " ".join([*crossings, f"For the mean cost over all of it {windows}."])


def findings(outcome: Outcome) -> list[str]:
    """Say what diverged, and how far the pendulum's steps are its motion."""
    found = [
        f"{capitalised(one.title)}: derivatives of {percent(1 - one.finite)} of the rollouts are not finite."
        for one in outcome.found.values()
        if one.finite < 1
    ]
    if outcome.adaptive is None:
        return found
    adaptive = outcome.adaptive
    is_true = adaptive.apart < 0.1
    count = len(is_true) if is_true.all() else int(is_true.argmin())
    if not count:
        return [*found, "The pendulum's steps are off the motion by more than a tenth at once: shorten the time step."]
    apart = np.abs(adaptive.stepped - adaptive.log_largest)[:count].max()
    return [
        *found,
        f"The pendulum's steps stay within a tenth of the motion by error control ({adaptive.num_steps} steps of order 8) up to "
        f"{adaptive.times[count - 1]:.3g} s; up to there the logarithm of the largest singular value differs by {apart:.2g} at "
        f"most, of {adaptive.stepped[:count].max():.3g}.",
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate what grows, and windows; errors by horizon are in metrics.csv."""
    return [_by_growth(outcome), _by_window(outcome)]


def _crossing(outcome: Outcome, one: Found) -> str:
    parts = []
    for label, crossing in one.crossovers.items():
        if crossing.horizon == one.times[0]:
            parts.append(f"the first on of {label}")
        elif np.isinf(crossing.horizon):
            parts.append(f"beyond {one.times[-1]:.3g} s of {label}")
        else:
            high = f"{crossing.high:.3g}" if np.isfinite(crossing.high) else "beyond the longest"
            parts.append(f"{crossing.horizon:.3g} s ({crossing.low:.3g} to {high}) of {label}")
    return (
        f"{capitalised(one.title)}: at {outcome.settings.sizes.num_samples} rollouts an estimate, zeroth order is as good from "
        f"a horizon of {joined(parts)}."
    )


def _window(one: Found) -> str:
    windows = one.windows
    best = min(windows.errors, key=lambda way: windows.errors[way].error.min())
    found, zeroth = windows.errors[best], windows.zeroth.error[0]
    at = int(found.error.argmin())
    least, whole = found.error[at], windows.errors[best[0], CUT].error[-1]
    if zeroth <= least:
        return f"zeroth order is best on the {one.title} ({_percent(zeroth)} off, the best window {_percent(least)})"
    if at == len(windows.lengths) - 1:
        return f"no window beats the whole horizon on the {one.title} ({_percent(least)} off, zeroth order {_percent(zeroth)})"
    kind = " with a value function" if best[1] == VALUED else ""
    return (
        f"windows of {windows.lengths[at]:.3g} s{kind} are best on the {one.title} ({_percent(least)} off, the whole horizon "
        f"{_percent(whole)}, zeroth order {_percent(zeroth)})"
    )


def _by_growth(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.found.values():
        largest = _rate(one.times, one.log_largest)
        exponents = one.exponents[-1].max(), one.exponents[-1].min()
        for label, each in one.errors.items():
            if label == ZEROTH:
                continue
            is_seen = each.bias > each.bias_noise
            first = f"{one.times[is_seen][0]:.3g}" if is_seen.any() else "–"
            most = _percent(float(each.bias[is_seen].max())) if is_seen.any() else "–"
            rate = _rate(one.times, np.log(each.variance)[None] / 2)[0]
            rates = [quantity(*largest), quantity(rate), *(quantity(float(exponent)) for exponent in exponents)]
            rows.append([one.title, label, f"{is_seen.sum()} of {len(is_seen)}", first, most, *rates])
    columns = (
        "problem", "estimator", "biased at", "first, s", "by up to",
        "largest singular value grows at, 1/s", "√variance, 1/s", "largest exponent, 1/s", "smallest",
    )  # fmt: skip
    caption = (
        "Horizons at which the bias is beyond chance, and its largest over the largest gradient: a few are seen by chance, "
        "and neighbours together. Rates over the second half of the time, of the product of Jacobians and of one sample; "
        "finite-time Lyapunov exponents at the end."
    )
    return Table(columns, rows, caption)


def _rate(times: np.ndarray, logs: np.ndarray) -> tuple[float, float]:
    """Return the slope over the second half of the time, and its standard error over rollouts."""
    half = len(times) // 2
    slopes = np.polyfit(times[half:], logs[:, half:].T, 1)[0]
    error = slopes.std(ddof=1) / np.sqrt(len(slopes)) if len(slopes) > 1 else 0.0
    return float(slopes.mean()), float(error)


def _by_window(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.found.values():
        windows = one.windows
        for label in dict.fromkeys(label for label, _ in windows.errors):
            kinds = [windows.errors[label, kind] for kind in (CUT, VALUED)]
            for at, length in enumerate(windows.lengths):
                cells = [_percent(share) for kind in kinds for share in (kind.error[at], kind.bias[at])]
                rows.append([one.title, label, f"{length:.3g}", *cells])
        rows.append([one.title, ZEROTH, "–", _percent(windows.zeroth.error[0]), "–", "–", "–"])
    fits = joined(f"{percent(one.windows.fit)} ({one.title})" for one in outcome.found.values())
    caption = (
        "Over the size of the gradient of the mean cost. Biases include what chance leaves; circles in the figure are beyond "
        f"it. Of the variance of the costs to come the value function explains {fits}."
    )
    columns = ("problem", "estimator", "window, s", "error", "bias", "error with value", "bias with value")
    return Table(columns, rows, caption)


def _percent(share: float) -> str:
    return percent(share) if share < 10 else f"{power(float(f'{share:.2g}'))} times"


COLOURS = {
    "first order, discrete": FIRST,
    "first order, slope": DEFAULT,
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
        "Grey: logarithm of the largest singular value of the product of all steps' Jacobians, rollout by rollout; thick, "
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
