"""The numbers of a planning experiment, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from experiments.planning.settings import NAMES, Settings


@dataclass(frozen=True)
class Attempt:
    """One way of planning."""

    model: str  # which linear models it used
    seed: int  # of its random numbers
    seconds: float  # wall time, compilation included where it was the first of its kind
    states: Float[np.ndarray, "states state"]  # that the system goes through under the controls that it found
    controls: Float[np.ndarray, "horizon 2"]  # finger speeds
    course: dict[str, Float[np.ndarray, " count"]]  # numbers by name along its iterations or nodes
    nodes: Float[np.ndarray, "nodes state"] | None = None  # the states of a tree, none for a trajectory
    parents: Int[np.ndarray, " nodes"] | None = None  # of these nodes

    @property
    def label(self) -> str:
        """Give a name for legends."""
        return NAMES[self.model]


@dataclass(frozen=True)
class Outcome:
    """All that was found."""

    settings: Settings  # of the run
    attempts: list[Attempt]  # in the order of the settings, seeds last
    # The shortest way of the first kind after trajectory optimisation, if it was asked for and there is one.
    polished: Attempt | None
    shown: Float[np.ndarray, "steps 5"]  # positions of the best plan at every time step, from a rollout of its own
    timestep: float  # between these (s)

    @property
    def goal(self) -> Float[np.ndarray, " 3"]:
        """Where the rod is to be."""
        return np.asarray(self.settings.goal)

    def distance(self, attempt: Attempt) -> float:
        """Give the distance of the rod from its goal in the end (m)."""
        return float(np.hypot(*(attempt.states[-1, 2:4] - self.goal[:2])))

    def angle(self, attempt: Attempt) -> float:
        """Give the angle between the rod and its goal in the end (rad)."""
        return float(abs(attempt.states[-1, 4] - self.goal[2]))

    def _off(self, state: np.ndarray) -> float:
        """Give how far the coordinate of the rod that is farthest off is from the goal, in tolerances."""
        tree = self.settings.tree
        units = np.array([tree.position_tolerance, tree.position_tolerance, tree.angle_tolerance])
        return float(np.max(np.abs(state[2:5] - self.goal) / units))

    def is_solved(self, attempt: Attempt) -> bool:
        """Say whether the rod is at its goal, as near as the settings ask for."""
        return self._off(attempt.states[-1]) <= 1

    def moved(self, attempt: Attempt) -> float:
        """Give which share of the way to the goal was made good, in units of the tolerances."""
        return 1 - self._off(attempt.states[-1]) / self._off(attempt.states[0])

    def of(self, model: str) -> list[Attempt]:
        """Give all attempts with one kind of linear model."""
        return [attempt for attempt in self.attempts if attempt.model == model]

    @property
    def best(self) -> Attempt:
        """Give what figures and video show: the polished way, else the shortest solved one of the first kind."""
        return self.polished or self.shortest(self.settings.models[0])

    def shortest(self, model: str) -> Attempt:
        """Give the solved attempt of fewest steps, or the one that came nearest."""
        attempts = self.of(model)
        solved = [attempt for attempt in attempts if self.is_solved(attempt)]
        return min(solved, key=lambda one: len(one.controls)) if solved else max(attempts, key=self.moved)

    def rows(self) -> list[dict[str, Any]]:
        """Give one row per attempt for the table of metrics."""
        named = [("", attempt) for attempt in self.attempts] + ([(" polished", self.polished)] if self.polished else [])
        return [
            {
                "model": attempt.model + suffix,
                "seed": attempt.seed,
                "is_solved": self.is_solved(attempt),
                "distance_m": self.distance(attempt),
                "angle_rad": self.angle(attempt),
                "num_steps": len(attempt.controls),
                "num_nodes": 0 if attempt.nodes is None else len(attempt.nodes),
                "final_cost": float(attempt.course["cost"].min()) if "cost" in attempt.course else float("nan"),
                "seconds": attempt.seconds,
            }
            for suffix, attempt in named
        ]
