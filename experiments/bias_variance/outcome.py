"""The numbers of a bias and variance experiment, and what follows from them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from experiments.bias_variance.settings import Settings

# A ratio of errors nearer to 1 is a tie: a few hundred samples know their variance no better.
MARGIN = 1.25

Cells = Float[np.ndarray, "stiffness angles"]


@dataclass(frozen=True)
class Interval:
    """Values with the ends of their confidence intervals."""

    value: Cells
    low: Cells
    high: Cells


@dataclass(frozen=True)
class Outcome:
    r"""Both estimates at each stiffness and angle. Costs are in m², so gradients are in m²/rad.

    Attributes:
        stiffness: effective, in 1/s²; of the sweep, ascending, and after it of MuJoCo's default if that was asked for.
        angles: in rad.
        has_default: whether the last row is MuJoCo's default contact, which differs from the sweep in impedance, too.
        settings: of the run.
        first: mean of the first-order estimate.
        zeroth: mean of the zeroth-order estimate.
        reference: the gradient of the smoothed cost.
        bias: first order less reference; its interval covers the errors of both.
        bias_error: its standard error.
        first_variance: of one sample.
        zeroth_variance: of one sample.
        finite: share of samples that could be used.
        grid: angles of the landscape.
        cost: without noise, by stiffness and grid.
        smooth_grid: angles of the mean cost under noise.
        smoothed: the mean cost under noise, by stiffness and smooth_grid.
    """

    stiffness: Float[np.ndarray, " stiffness"]
    angles: Float[np.ndarray, " angles"]
    has_default: bool
    settings: Settings
    first: Interval
    zeroth: Interval
    reference: Interval
    bias: Interval
    bias_error: Cells
    first_variance: Interval
    zeroth_variance: Interval
    finite: Cells
    grid: Float[np.ndarray, " grid"]
    cost: Float[np.ndarray, "stiffness grid"]
    smooth_grid: Float[np.ndarray, " smooth_grid"]
    smoothed: Float[np.ndarray, "stiffness smooth_grid"]

    @property
    def swept(self) -> slice:
        """The rows of the sweep."""
        return slice(0, len(self.stiffness) - self.has_default)

    @property
    def is_biased(self) -> Bool[np.ndarray, "stiffness angles"]:
        """Where the bias differs from zero, beyond chance over all cells together.

        Of many intervals some miss by chance, so each is widened until all of them hold together as often as one
        is said to (Bonferroni).
        """
        tail = (1 - self.settings.confidence) / 2 / self.bias.value.size
        return np.abs(self.bias.value) > stats.t.isf(tail, self.settings.num_samples - 1) * self.bias_error

    @property
    def has_wrong_sign(self) -> Bool[np.ndarray, "stiffness angles"]:
        """Where both means are surely not zero and point in opposite directions."""
        first, reference = self.first, self.reference
        up_for_down = (first.low > 0) & (reference.high < 0)
        return up_for_down | ((first.high < 0) & (reference.low > 0))

    @property
    def first_error(self) -> Cells:
        """Expected error of a first-order estimate within the budget: root of bias² + variance / rollouts."""
        bias = np.where(self.is_biased, self.bias.value, 0.0)
        return np.sqrt(bias**2 + self.first_variance.value / self.settings.rollouts_per_gradient)

    @property
    def zeroth_error(self) -> Cells:
        """Expected error of a zeroth-order estimate within the budget."""
        return np.sqrt(self.zeroth_variance.value / self.settings.rollouts_per_gradient)

    @property
    def first_wins(self) -> Bool[np.ndarray, "stiffness angles"]:
        """Where the first-order estimate is expected to be clearly closer."""
        return MARGIN * self.first_error < self.zeroth_error

    @property
    def zeroth_wins(self) -> Bool[np.ndarray, "stiffness angles"]:
        """Where the zeroth-order estimate is expected to be clearly closer."""
        return MARGIN * self.zeroth_error < self.first_error

    def rows(self) -> list[dict[str, float | bool]]:
        """One row per stiffness and angle, for metrics.csv."""
        intervals = {
            "first_order": self.first,
            "zeroth_order": self.zeroth,
            "reference": self.reference,
            "bias": self.bias,
            "first_order_variance": self.first_variance,
            "zeroth_order_variance": self.zeroth_variance,
        }
        rows = []
        for i, j in np.ndindex(self.bias.value.shape):
            row = {
                "stiffness": float(self.stiffness[i]),
                "angle": float(self.angles[j]),
                "is_default": bool(i >= self.swept.stop),
            }
            for name, interval in intervals.items():
                row[name] = float(interval.value[i, j])
                row[f"{name}_low"] = float(interval.low[i, j])
                row[f"{name}_high"] = float(interval.high[i, j])
            row |= {
                "is_biased": bool(self.is_biased[i, j]),
                "first_order_error": float(self.first_error[i, j]),
                "zeroth_order_error": float(self.zeroth_error[i, j]),
                "finite_share": float(self.finite[i, j]),
            }
            rows.append(row)
        return rows
