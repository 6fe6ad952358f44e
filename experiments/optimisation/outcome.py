"""The numbers of an optimisation experiment, and what follows from them."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from experiments.optimisation.settings import MethodSettings, Settings
from mjxgrad.diagnostics import Comparison, bias_interval, mean_interval

# Costs are sums over hundreds of steps; seeds that agree to this share differ by rounding alone.
ROUNDING = 1e-6


@dataclass(frozen=True)
class Run:
    """All seeds of one method."""

    method: MethodSettings  # its settings
    final_cost: Float[np.ndarray, " seeds"]  # without noise, after the last step; infinite for a run that was lost
    # Without noise, by seed and evaluation, the last one after the last step.
    cost: Float[np.ndarray, "seeds evaluations"]
    rollouts: Int[np.ndarray, " evaluations"]  # spent before each evaluation, of the seed that spent most
    seconds: Float[np.ndarray, " evaluations"]  # likewise, of all seeds together, without compilation
    alpha: Float[np.ndarray, "seeds steps"]  # weight of the first-order part, by seed and step
    # For each sentence, at which steps of which seeds it was why; empty for a method without a choice.
    reasons: dict[str, Bool[np.ndarray, "seeds steps"]] = field(repr=False)
    num_skipped: Int[np.ndarray, " seeds"]  # steps not taken, because the estimate was not finite, by seed
    finite_share: float  # of all rollouts
    rollouts_per_step: int  # most of all steps
    compile_seconds: float  # spent on compilation

    @property
    def is_lost(self) -> Bool[np.ndarray, " seeds"]:
        """Say which runs ended without a finite cost."""
        return ~np.isfinite(self.final_cost)

    @property
    def kept(self) -> Float[np.ndarray, " kept"]:
        """Give the final costs of the others."""
        return self.final_cost[~self.is_lost]

    @property
    def mean(self) -> float:
        """Give their mean, NaN if all runs were lost."""
        return float(self.kept.mean()) if self.kept.size else np.nan

    @property
    def spread(self) -> float:
        """Give their standard deviation, NaN for fewer than two."""
        return float(self.kept.std(ddof=1)) if self.kept.size > 1 else np.nan

    @property
    def seconds_per_step(self) -> float:
        """Give the time of one step of one seed."""
        return float(self.seconds[-1]) / self.alpha.size

    @property
    def rank(self) -> tuple[int, float]:
        """Give what runs are ordered by: fewer lost ones first, then a lower mean."""
        return int(self.is_lost.sum()), self.mean if self.kept.size else np.inf

    def interval(self, confidence: float) -> Float[np.ndarray, " 2"]:
        """Give the interval of the mean over seeds."""
        count = self.kept.size
        return mean_interval(self.mean, self.spread / np.sqrt(max(count, 1)), count, confidence)


@dataclass(frozen=True)
class Difference:
    """One method less another, in final cost: the difference of the means with Welch's interval.

    Beside it stands the p-value of Mann and Whitney's two-sided rank test, a lost run ranking last; it counts below what is left
    of the confidence.
    """

    ours: Run
    other: Run
    value: float
    low: float
    high: float
    p_value: float
    confidence: float

    @classmethod
    def of(cls, ours: Run, other: Run, confidence: float) -> "Difference":
        """Compare two methods."""
        errors = [run.spread / np.sqrt(max(run.kept.size, 1)) for run in (ours, other)]
        low, high = bias_interval(
            ours.mean, errors[0], ours.kept.size, other.mean, errors[1], other.kept.size, confidence
        )
        # Rounded, so that runs that are the same but for rounding tie.
        size = max(ROUNDING * abs(other.mean), 1e-300) if other.kept.size else 1.0
        first, second = (np.where(run.is_lost, np.inf, np.round(run.final_cost / size)) for run in (ours, other))
        p_value = float(stats.mannwhitneyu(first, second).pvalue)
        return cls(ours, other, ours.mean - other.mean, float(low), float(high), p_value, confidence)

    @property
    def is_above(self) -> bool:
        """Say whether the one ends higher beyond seed noise, by the means, by the ranks, or by lost runs."""
        return int(self.ours.is_lost.sum()) > int(self.other.is_lost.sum()) or self._is_beyond(1)

    @property
    def is_below(self) -> bool:
        """Say whether it ends lower beyond seed noise."""
        return not self.is_above and self._is_beyond(-1)

    def _is_beyond(self, sign: int) -> bool:
        noise = ROUNDING * abs(self.other.mean)
        # To say which way the ranks point.
        shift = float(np.median(self.ours.final_cost) - np.median(self.other.final_cost))
        is_ranked = self.p_value < 1 - self.confidence
        return (self.low if sign > 0 else -self.high) > noise or (is_ranked and sign * shift > noise)


@dataclass(frozen=True)
class Outcome:
    """All methods on one task."""

    settings: Settings  # of the experiment
    num_samples: int  # rollouts per step
    num_steps: int  # of each run
    dim: int  # number of parameters
    start_cost: float  # without noise, before the first step
    # Published mean and standard deviation of the final cost, by what they belong to.
    reference: dict[str, tuple[float, float]]
    runs: list[Run]  # in the order of the settings
    errors: Comparison | None  # of one estimate at the start, of the methods that estimate; None if it was not measured

    @cached_property
    def verdicts(self) -> list[Difference]:
        """Compare α-order as it comes with the better of first and zeroth order; empty if one of them is missing."""
        ours = [run for run in self.runs if run.method.is_default_alpha]
        pure = [run for run in self.runs if run.method.name in ("first_order", "zeroth_order")]
        if not ours or not pure:
            return []
        return [Difference.of(ours[0], min(pure, key=lambda run: run.rank), self.settings.confidence)]

    @property
    def best(self) -> Run:
        """Give the method that ends lowest."""
        return min(self.runs, key=lambda run: run.rank)

    def published(self, run: Run) -> tuple[float, float] | None:
        """Give the published result of a method."""
        method = run.method
        if method.name == "first_order":
            return self.reference.get("first")
        if method.name == "zeroth_order" and method.baseline == "zero_noise" and not method.antithetic:
            return self.reference.get("zeroth")
        if method.name != "alpha_order" or method.control_variate is not False:
            return None
        return self.reference.get({"bias_constrained": "alpha", "concavity": "ddcg"}.get(method.rule or "", ""))

    def relative_error(self, run: Run) -> Float[np.ndarray, " 3"] | None:
        """Give the error of one estimate at the start over the gradient's norm, with its interval."""
        if self.errors is None or run.method.label not in self.errors.names:
            return None
        row = self.errors.names.index(run.method.label)
        ends = self.errors.rmse_interval[:, row]
        return np.array([self.errors.rmse[row], *ends]) / np.linalg.norm(self.errors.reference)

    def rows(self) -> list[dict[str, Any]]:
        """One row per method, seed and evaluation, for metrics.csv."""
        return [
            {
                "task": self.settings.task,
                "dynamics": self.settings.dynamics,
                "method": run.method.label,
                "seed": seed,
                "rollouts": int(run.rollouts[i]),
                "seconds": float(run.seconds[i]),
                "cost": float(run.cost[seed, i]),
                "is_final": i == run.cost.shape[1] - 1,
                "steps_skipped": int(run.num_skipped[seed]),
                "mean_alpha": float(run.alpha[seed].mean()),
            }
            for run in self.runs
            for seed, i in np.ndindex(run.cost.shape)
        ]
