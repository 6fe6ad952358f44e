"""The answer of an experiment on long horizons in words, computed from its numbers."""

import numpy as np

from experiments.long_horizon.outcome import Found, Outcome
from experiments.report import Table
from experiments.theme import power
from experiments.words import capitalised, percent, quantity


def verdict(outcome: Outcome) -> str:
    """Say up to which horizon first order is better, and what to do beyond."""
    return " ".join(sentence for one in outcome.found.values() for sentence in (_crossing(outcome, one), _window(one)))


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    found = []
    for one in outcome.found.values():
        found += [_growth(one), *_biases(one)]
        if one.finite < 1:
            found.append(
                f"{capitalised(one.title)}: derivatives of {1 - one.finite:.1%} of the rollouts are not finite."
            )
    return [*found, *_adaptive(outcome)]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate errors at some horizons, and windows."""
    return [_by_horizon(outcome), _by_window(outcome)]


def _crossing(outcome: Outcome, one: Found) -> str:
    parts = []
    for label, crossing in one.crossovers.items():
        if crossing.horizon == one.times[0]:
            parts.append(f"never of {label}")
        elif np.isinf(crossing.horizon):
            parts.append(f"beyond {one.times[-1]:.3g} s of {label}")
        else:
            high = f"{crossing.high:.3g}" if np.isfinite(crossing.high) else "beyond the longest"
            parts.append(f"{crossing.horizon:.3g} s ({crossing.low:.3g} to {high}) of {label}")
    return (
        f"{capitalised(one.title)}: at {outcome.settings.sizes.num_samples} rollouts an estimate, zeroth order is as good from "
        f"a horizon of {' and '.join(parts)}."
    )


def _window(one: Found) -> str:
    label, kind, at = min(
        (
            (label, kind, at)
            for label, cut in one.windows.items()
            for kind in range(2)
            for at in range(len(cut.lengths))
        ),
        key=lambda place: one.windows[place[0]].error[place[1], place[2]],
    )
    cut = one.windows[label]
    best = cut.error[kind, at]
    others = f"{label} over the whole horizon has {_percent(cut.error[0, -1])}, zeroth order {_percent(cut.zeroth[0])}"
    if cut.zeroth[0] <= best:
        off = f"{_percent(cut.zeroth[0])} off; the best has {_percent(best)}"
        return f"For the mean cost over all of it no window beats zeroth order, {off}."
    if at == len(cut.lengths) - 1:
        return f"For the mean cost over all of it no window beats the whole horizon: {others}."
    how = "with a value function" if kind else "without a value function"
    length = one.times[0] * cut.lengths[at]
    return (
        f"For the mean cost over all of it windows of {length:.3g} s {how} are best, {_percent(best)} off "
        f"(bias {_percent(cut.bias[kind, at])}, where chance leaves up to {_percent(cut.bias_noise[kind, at])}); {others}."
    )


def _growth(one: Found) -> str:
    rate, error = one.growth_rate
    rates = [f"{quantity(rate)} 1/s with {label}" for label, rate in one.variance_rate.items()]
    return (
        f"{capitalised(one.title)}: over the second half of the time the largest singular value grows at {quantity(rate, error)} "
        f"1/s; the root of the variance of one sample at {' and '.join(rates)}. The largest finite-time exponent at the end is "
        f"{quantity(float(one.exponents[-1].max()))} 1/s, the smallest {quantity(float(one.exponents[-1].min()))} 1/s."
    )


def _biases(one: Found) -> list[str]:
    found = []
    for each in one.estimators[:-1]:
        is_seen = each.bias > each.bias_noise
        # A few are seen by chance, and neighbouring horizons together.
        if is_seen.mean() > 0.1:
            first = one.times[np.flatnonzero(is_seen)[0]]
            found.append(
                f"{capitalised(one.title)}, {each.label}: biased beyond chance at {is_seen.sum()} of {len(is_seen)} horizons, "
                f"first at {first:.3g} s, by up to {_percent(float(each.bias[is_seen].max()))} of the largest gradient."
            )
    return found


def _adaptive(outcome: Outcome) -> list[str]:
    adaptive = outcome.adaptive
    if adaptive is None:
        return []
    apart = np.abs(adaptive.stepped - adaptive.log_largest)
    is_true = adaptive.apart < 0.1
    count = len(is_true) if is_true.all() else int(is_true.argmin())
    if not count:
        return [
            "The pendulum's steps are off the motion by more than a tenth from the first time on: shorten the time step."
        ]
    growth = f"{apart[:count].max():.2g} at most, of {adaptive.stepped[:count].max():.3g}"
    return [
        f"The pendulum's steps stay within a tenth of the motion by error control ({adaptive.num_steps} steps of order 8) up to "
        f"{adaptive.times[count - 1]:.3g} s; up to there the logarithm of the largest singular value differs by {growth}."
    ]


def _by_horizon(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.found.values():
        places = np.unique(np.linspace(0, len(one.times) - 1, 6).round().astype(int))
        for each in one.estimators:
            numbers = [[float(x) for x in (each.error[i], *each.interval[:, i])] for i in places]
            cells = [f"{_percent(error)} ({_percent(low)} to {_percent(high)})" for error, low, high in numbers]
            rows.append([one.title, each.label, *cells])
    shares = [f"{share:.0%}" for share in np.linspace(0, 1, 6)]
    heads = [f"{share} of the time" for share in shares]
    heads[0] = "first time"
    return Table(
        ("problem", "estimator", *heads),
        rows,
        "Root mean squared error with its interval, over the largest gradient of all horizons.",
    )


def _by_window(outcome: Outcome) -> Table:
    rows = []
    for one in outcome.found.values():
        for label, cut in one.windows.items():
            for at, length in enumerate(cut.lengths):
                cells = [
                    cell for kind in range(2) for cell in (_percent(cut.error[kind, at]), _percent(cut.bias[kind, at]))
                ]
                rows.append([one.title, label, f"{one.times[0] * length:.3g}", *cells])
            rows.append([one.title, "zeroth order", "—", _percent(cut.zeroth[0]), "—", "—", "—"])
    return Table(
        ("problem", "estimator", "window, s", "error", "bias", "error with value", "bias with value"),
        rows,
        "Over the size of the gradient of the mean cost. Biases include what chance leaves; circles in the figure are beyond it.",
    )


def _percent(share: float) -> str:
    return percent(share) if share < 10 else f"{power(float(f'{share:.2g}'))} times"
