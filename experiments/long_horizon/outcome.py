"""The numbers of an experiment on long horizons."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.long_horizon.settings import Settings
from mjxgrad.diagnostics import Crossover

ZEROTH = "zeroth order"
CUT, VALUED = "cut", "with a value function"


@dataclass(frozen=True)
class Errors:
    """Errors of one way to estimate gradients, of some costs or by some windows, over the largest gradient's size.

    Attributes:
        error: root mean squared error of an estimate.
        interval: of it.
        bias: distance of the mean of all estimates from the reference.
        bias_noise: distance up to which it can be chance.
        variance: of one sample, summed over parameters, in the gradient's own units.
        squares: of the errors, by repeat, less the reference's own.
    """

    error: Float[np.ndarray, " kinds"]
    interval: Float[np.ndarray, "2 kinds"]
    bias: Float[np.ndarray, " kinds"]
    bias_noise: Float[np.ndarray, " kinds"]
    variance: Float[np.ndarray, " kinds"]
    squares: Float[np.ndarray, "repeats kinds"]


@dataclass(frozen=True)
class Windows:
    """Estimates of the gradient of the mean cost over the whole horizon, cut into windows; errors over its size.

    Attributes:
        lengths: of the windows, in s, the last one the whole horizon.
        errors: by derivative and by `CUT` or `VALUED`.
        zeroth: of zeroth order.
        fit: share of the variance of the costs to come that the value function explains, in the median over times.
    """

    lengths: Float[np.ndarray, " windows"]
    errors: dict[tuple[str, str], Errors]
    zeroth: Errors
    fit: float


@dataclass(frozen=True)
class Found:
    """All that was measured on one problem.

    Attributes:
        title: of the problem.
        times: at which the horizon may end (s).
        costs: mean cost at these (m).
        errors: by estimator, zeroth order last, of the gradient of the mean cost at each time.
        crossovers: of each first order with zeroth.
        log_largest: of the product of Jacobians, by rollout.
        exponents: finite-time Lyapunov exponents, median over rollouts (1/s).
        windows: what cutting the derivative makes of it.
        finite: share of rollouts with finite derivatives.
    """

    title: str
    times: Float[np.ndarray, " times"]
    costs: Float[np.ndarray, " times"]
    errors: dict[str, Errors]
    crossovers: dict[str, Crossover]
    log_largest: Float[np.ndarray, "rollouts times"]
    exponents: Float[np.ndarray, "times n"]
    windows: Windows
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
    """All that was measured: by problem, and the pendulum by error control if it is among them."""

    settings: Settings
    found: dict[str, Found]
    adaptive: Adaptive | None

    def rows(self) -> list[dict[str, Any]]:
        """One row per problem, estimator and horizon, for metrics.csv."""
        return [
            {
                "problem": name,
                "estimator": label,
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
            for label, each in one.errors.items()
            for i, time in enumerate(one.times)
        ]
