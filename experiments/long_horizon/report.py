"""The answer of an experiment on long horizons in words, computed from its numbers."""

import numpy as np

from experiments.long_horizon.measure import CUT, VALUED, ZEROTH, Found, Outcome
from experiments.report import Table
from experiments.theme import power
from experiments.words import capitalised, joined, percent, quantity


def verdict(outcome: Outcome) -> str:
    """Say up to which horizon first order is better, and what to do beyond."""
    crossings = [_crossing(outcome, one) for one in outcome.found.values()]
    windows = "; ".join(_window(one) for one in outcome.found.values())
    return " ".join([*crossings, f"For the mean cost over all of it {windows}."])


def findings(outcome: Outcome) -> list[str]:
    """Say what diverged, and how far the pendulum's steps are its motion."""
    found = [
        f"{capitalised(one.title)}: derivatives of {1 - one.finite:.1%} of the rollouts are not finite."
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
