"""The numbers of an experiment on long horizons."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.long_horizon.settings import Settings
from mjxgrad.diagnostics import Crossover

ZEROTH = "zeroth order"
# Standard errors of a mean. Two would do for one in twenty of normal samples; derivatives along chaotic motions have tails so
# heavy that a few dozen repeats show too little of their spread.
BEYOND_CHANCE = 3.0


@dataclass(frozen=True)
class Errors:
    """One estimator's over horizons.

    Attributes:
        label: such as "first order, event".
        error: root mean squared error of an estimate, over the size of the reference's largest; that of the cost at the
            horizon alone.
        interval: of it.
        bias: distance of the mean of all estimates from the reference, likewise.
        bias_noise: distance up to which it can be chance.
        variance: of one sample, summed over parameters.
    """

    label: str
    error: Float[np.ndarray, " times"]
    interval: Float[np.ndarray, "2 times"]
    bias: Float[np.ndarray, " times"]
    bias_noise: Float[np.ndarray, " times"]
    variance: Float[np.ndarray, " times"]


@dataclass(frozen=True)
class Windows:
    """Estimates of the gradient of the mean cost over the whole horizon, cut into windows.

    Attributes:
        lengths: of the windows, in segments, the last one the whole horizon.
        error: root mean squared error, plain and with a value function, over the size of the reference.
        interval: of it.
        bias: distance of the mean from the reference, likewise.
        bias_noise: distance up to which it can be chance.
        zeroth: error of zeroth order, with its interval.
        fit: share of the variance of the costs to come that the value function explains, in the median over times.
    """

    lengths: tuple[int, ...]
    error: Float[np.ndarray, "2 windows"]
    interval: Float[np.ndarray, "2 ends windows"]
    bias: Float[np.ndarray, "2 windows"]
    bias_noise: Float[np.ndarray, "2 windows"]
    zeroth: Float[np.ndarray, " 3"]
    fit: float


@dataclass(frozen=True)
class Found:
    """All that was measured on one problem.

    Attributes:
        title: of the problem.
        times: at which the horizon may end (s).
        costs: mean cost at these (m).
        reference: gradient of the mean cost there.
        reference_error: its standard error.
        estimators: first orders, then zeroth.
        crossovers: of each first order with zeroth.
        log_largest: of the product of Jacobians, by rollout.
        exponents: finite-time Lyapunov exponents, median over rollouts (1/s).
        growth_rate: of the logarithm of the largest singular value over the second half of the time, with its error.
        variance_rate: of the logarithm of each first order's variance over the same, halved.
        windows: by first order.
        finite: share of rollouts with finite derivatives.
    """

    title: str
    times: Float[np.ndarray, " times"]
    costs: Float[np.ndarray, " times"]
    reference: Float[np.ndarray, "times dim"]
    reference_error: Float[np.ndarray, "times dim"]
    estimators: list[Errors]
    crossovers: dict[str, Crossover]
    log_largest: Float[np.ndarray, "rollouts times"]
    exponents: Float[np.ndarray, "times n"]
    growth_rate: tuple[float, float]
    variance_rate: dict[str, float]
    windows: dict[str, Windows]
    finite: float


@dataclass(frozen=True)
class Adaptive:
    """The pendulum by error control, beside the steps.

    Attributes:
        times: in s.
        apart: distance of the stepped state from the adaptive one, over the state's size.
        log_largest: of the derivative by the start, by differences of adaptive rollouts.
        stepped: the same of the steps.
        num_steps: of the adaptive integration.
    """

    times: Float[np.ndarray, " times"]
    apart: Float[np.ndarray, " times"]
    log_largest: Float[np.ndarray, " times"]
    stepped: Float[np.ndarray, " times"]
    num_steps: int


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        found: by problem.
        adaptive: of the pendulum; None without it.
    """

    settings: Settings
    found: dict[str, Found]
    adaptive: Adaptive | None

    def rows(self) -> list[dict[str, Any]]:
        """One row per problem, estimator and horizon, for metrics.csv."""
        return [
            {
                "problem": name,
                "estimator": each.label,
                "horizon": float(time),
                "mean_cost": float(one.costs[i]),
                "relative_error": float(each.error[i]),
                "relative_error_low": float(each.interval[0, i]),
                "relative_error_high": float(each.interval[1, i]),
                "relative_bias": float(each.bias[i]),
                "variance": float(each.variance[i]),
                "median_log_largest_singular_value": float(np.median(one.log_largest[:, i])),
            }
            for name, one in self.found.items()
            for each in one.estimators
            for i, time in enumerate(one.times)
        ]
