"""The numbers of the experiment on billiards."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.billiards.settings import MethodSettings, Settings

IDLE = 2.0  # m², the cost of standing still


@dataclass(frozen=True)
class Run:
    """One descent.

    Attributes:
        method: what was asked for.
        steps: at which the true cost was measured.
        cost: there, in m²; without noise and with the contact as it is.
        final_cost: of the best forces that were measured.
        hard_cost: of the same forces with balls that collide in no time, by another program.
        forces: (pieces, 2), in N.
        qpos: (states, 4) of the stroke with these forces.
        has_touched: whether the balls touch at the start of the descent.
        num_rollouts: spent.
        seconds: of running.
        compile_seconds: of compiling.
    """

    method: MethodSettings
    steps: np.ndarray
    cost: np.ndarray
    final_cost: float
    hard_cost: float
    forces: np.ndarray
    qpos: np.ndarray
    has_touched: bool
    num_rollouts: int
    seconds: float
    compile_seconds: float

    @property
    def is_solved(self) -> bool:
        """Whether hard balls, too, are within one per cent of the best."""
        return max(self.final_cost, self.hard_cost) < 1.01 * 1.3965421601

    @property
    def is_stuck(self) -> bool:
        """Whether it ends within one per cent of standing still, or above."""
        return self.final_cost > 0.99 * IDLE


@dataclass(frozen=True)
class Outcome:
    """All numbers.

    Attributes:
        settings: of the run.
        optimum: cost, time of collision (s) and speed at it (m/s) of the best stroke with hard balls.
        runs: one per method.
        timestep: of the scene, in s.
    """

    settings: Settings
    optimum: tuple[float, float, float]
    runs: tuple[Run, ...]
    timestep: float

    def rows(self) -> list[dict[str, Any]]:
        """Give the rows of metrics.csv."""
        return [
            {
                "method": run.method.label,
                "step": int(step),
                "cost": float(cost),
                "final_cost": run.final_cost,
                "hard_cost": run.hard_cost,
                "touches_at_start": run.has_touched,
                "num_rollouts": run.num_rollouts,
                "seconds": run.seconds,
                "compile_seconds": run.compile_seconds,
            }
            for run in self.runs
            for step, cost in zip(run.steps, run.cost, strict=True)
        ]
