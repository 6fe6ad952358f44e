"""The numbers of an experiment on a textbook problem, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from experiments.textbook.settings import Settings
from mjxgrad.diagnostics import Comparison, EmpiricalBias


@dataclass(frozen=True)
class Curves:
    """The problem along its parameter.

    Attributes:
        grid: of the parameter.
        cost: without noise.
        smoothed: mean cost under noise.
        gradient: of the mean cost.
        first_order_mean: what first order converges to.
    """

    grid: Float[np.ndarray, " grid"]
    cost: Float[np.ndarray, " grid"]
    smoothed: Float[np.ndarray, " grid"]
    gradient: Float[np.ndarray, " grid"]
    first_order_mean: Float[np.ndarray, " grid"]


@dataclass(frozen=True)
class Missing:
    """How often samples miss the slope of a soft step.

    Attributes:
        counts: numbers of samples N.
        probability: exact chance of one sample to hit the slope, by stiffness.
        frequency: with which N simulated samples all missed it, by stiffness and N.
        found: what first-order samples tell of it, by stiffness.
    """

    counts: Int[np.ndarray, " counts"]
    probability: Float[np.ndarray, " stiffness"]
    frequency: Float[np.ndarray, "stiffness counts"]
    found: list[EmpiricalBias]


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        gradient: the truth at the shown stiffness.
        by_samples: one comparison per number of rollouts.
        by_stiffness: one per stiffness.
        exact_by_samples: root-mean-square error in closed form, by label, where there is one.
        exact_by_stiffness: likewise.
        curves: of the shown problem.
        missing: for the soft step.
    """

    settings: Settings
    gradient: float
    by_samples: list[Comparison]
    by_stiffness: list[Comparison]
    exact_by_samples: dict[str, Float[np.ndarray, " settings"]]
    exact_by_stiffness: dict[str, Float[np.ndarray, " settings"]]
    curves: Curves
    missing: Missing | None

    @property
    def labels(self) -> list[str]:
        """Names of the estimators."""
        return [one.label for one in self.settings.estimators]

    @property
    def is_biased(self) -> Bool[np.ndarray, "settings estimators"]:
        """Where the bias differs from zero, beyond chance over all numbers of rollouts and estimators (Bonferroni)."""
        tail = (1 - self.settings.confidence) / 2 / (len(self.by_samples) * len(self.labels))
        found = []
        for table in self.by_samples:
            error = np.sqrt(table.variance / table.num_finite)
            # Where nothing varies, a difference of rounding alone is none.
            reach = stats.t.isf(tail, table.num_finite - 1) * error + 1e-9 * abs(self.gradient)
            found.append(np.abs(table.bias[:, 0]) > reach)
        return np.array(found)

    @property
    def agreement(self) -> tuple[int, int]:
        """How many intervals of the error contain the closed form, and how many there are."""
        hits = total = 0
        both = ((self.by_samples, self.exact_by_samples), (self.by_stiffness, self.exact_by_stiffness))
        for tables, exact in both:
            for label, values in exact.items():
                row = self.labels.index(label)
                for table, value in zip(tables, values, strict=True):
                    low, high = table.rmse_interval[:, row]
                    total += 1
                    hits += bool(low <= value * (1 + 1e-9) and value <= high * (1 + 1e-9))
        return hits, total

    def rows(self) -> list[dict[str, Any]]:
        """One row per setting and estimator, for metrics.csv."""
        settings = self.settings
        cells = [
            (settings.shown_stiffness, table, self.exact_by_samples, i) for i, table in enumerate(self.by_samples)
        ] + [
            (stiffness, table, self.exact_by_stiffness, i)
            for i, (stiffness, table) in enumerate(zip(settings.stiffness, self.by_stiffness, strict=True))
        ]
        return [
            {
                "stiffness": stiffness,
                "estimator": label,
                "num_samples": int(table.num_samples[row]),
                "num_rollouts": int(table.num_rollouts[row]),
                "num_gradient_rollouts": int(table.num_gradient_rollouts[row]),
                "num_finite": int(table.num_finite[row]),
                "reference": float(table.reference[0]),
                "mean": float(table.mean[row, 0]),
                "bias": float(table.bias[row, 0]),
                "bias_low": float(table.bias_interval[0, row, 0]),
                "bias_high": float(table.bias_interval[1, row, 0]),
                "rmse": float(table.rmse[row]),
                "rmse_low": float(table.rmse_interval[0, row]),
                "rmse_high": float(table.rmse_interval[1, row]),
                "exact_rmse": float(exact[label][i]) if label in exact else None,
                "variance": float(table.variance[row]),
                "variance_low": float(table.variance_interval[0, row]),
                "variance_high": float(table.variance_interval[1, row]),
                "variance_method": table.variance_methods[row],
                "claimed_variance": float(table.claimed_variance[row]),
            }
            for stiffness, table, exact, i in cells
            for row, label in enumerate(self.labels)
        ]
