"""The numbers of the rolling pin's experiment, and what follows from them."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.rolling_pin.settings import Settings
from mjxgrad.tasks.rolling_pin import RollingPin


@dataclasses.dataclass(frozen=True)
class Descent:
    """One descent.

    Attributes:
        label: of the derivative it went along.
        params: where it ended.
        costs: true cost, without noise, before every step and in the end.
        alpha: weight of the first-order part, by step.
        num_samples: rollouts per step.
        num_skipped: steps without a finite estimate.
    """

    label: str
    params: Float[np.ndarray, " dim"]
    costs: Float[np.ndarray, " points"]
    alpha: Float[np.ndarray, " steps"]
    num_samples: int
    num_skipped: int

    def steps_to(self, cost: float) -> int | None:
        """Give the first step whose result is below a cost, from which on it stays there."""
        above = np.flatnonzero(~(self.costs < cost))
        first = 0 if not above.size else int(above[-1]) + 1
        return first if first < len(self.costs) else None

    @property
    def has_moved(self) -> bool:
        """Whether the true cost ever changed by more than rounding."""
        return bool(np.ptp(self.costs) > 1e-6 * self.costs[0])


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The numbers.

    Attributes:
        settings: of the run.
        descents: in the order of the table.
        start_gradient: largest element of the gradient of the true cost at the start.
        target: wanted heights of the pillars (m).
        heights: those that each descent ends with (m).
        motion: positions over time under the best controls.
        task: that was solved, for drawing.
    """

    settings: Settings
    descents: list[Descent]
    start_gradient: float
    target: Float[np.ndarray, " pillars"]
    heights: dict[str, Float[np.ndarray, " pillars"]]
    motion: Float[np.ndarray, "states nq"]
    task: RollingPin

    @property
    def best(self) -> Descent:
        """The descent that ends lowest."""
        return min(self.descents, key=lambda one: one.costs[-1])

    @property
    def plain(self) -> Descent:
        """First order, as it comes."""
        return next(one for one in self.descents if one.label == "first order")

    def is_solved(self, descent: Descent) -> bool:
        """Say whether a descent ends below the cost that counts as solved."""
        return bool(descent.costs[-1] < self.settings.solved_below)

    def rows(self) -> list[dict[str, Any]]:
        """Give the true cost of every step of every descent, for metrics.csv."""
        return [
            {"method": one.label, "step": step, "rollouts": step * one.num_samples, "true_cost": float(cost)}
            for one in self.descents
            for step, cost in enumerate(one.costs)
        ]
