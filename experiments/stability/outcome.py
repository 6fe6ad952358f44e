"""The numbers of an experiment on stability, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.stability.classes import Derivative, Motion
from experiments.stability.grid import RANDOM, Points
from experiments.stability.scenes import StabilityScene
from experiments.stability.settings import Settings

C_MUJOCO = "C MuJoCo"


@dataclass(frozen=True)
class Behaviour:
    """What one simulator did on all points of a scene.

    Attributes:
        motion: values of `Motion`.
        derivative: values of `Derivative`, of the discrete gradient along a change of the start.
        by_parameters: the same along a change of the model's parameters; none for C MuJoCo.
        event: the same of the event gradient; none where it was not asked for.
        is_silent: numbers that are not finite left the rollout without a flag.
        is_untold: some step is not solved, and `Trajectory.unsolved` is zero.
        is_unflagged: the gradient is not finite or explodes where `Trajectory.diverged` is false.
        is_missed: the same where `soundness` finds nothing wrong either.
        gain: largest kinetic energy over what there was to draw on.
    """

    motion: Int[np.ndarray, " points"]
    derivative: Int[np.ndarray, " points"]
    by_parameters: Int[np.ndarray, " points"] | None
    event: Int[np.ndarray, " points"] | None
    is_silent: Bool[np.ndarray, " points"]
    is_untold: Bool[np.ndarray, " points"]
    is_unflagged: Bool[np.ndarray, " points"]
    is_missed: Bool[np.ndarray, " points"]
    gain: Float[np.ndarray, " points"]


@dataclass(frozen=True)
class SceneOutcome:
    """One scene.

    Attributes:
        scene: of the catalogue.
        points: of its grid.
        behaviour: by simulator: `C_MUJOCO`, and mjxgrad by its precision.
        apart: difference of the final positions from those of C MuJoCo, over what a body flies in the rollout, by precision.
    """

    scene: StabilityScene
    points: Points
    behaviour: dict[str, Behaviour]
    apart: dict[str, Float[np.ndarray, " points"]]

    def worse(self, precision: str) -> Bool[np.ndarray, " points"]:
        """Where mjxgrad's motion is of a worse kind than that of C MuJoCo.

        Args:
            precision: of mjxgrad.
        """
        return _ranks(self.behaviour[precision].motion) > _ranks(self.behaviour[C_MUJOCO].motion)

    def better(self, precision: str) -> Bool[np.ndarray, " points"]:
        """Where it is of a better kind.

        Args:
            precision: of mjxgrad.
        """
        return _ranks(self.behaviour[precision].motion) < _ranks(self.behaviour[C_MUJOCO].motion)

    def plane(self, index: int, values: np.ndarray) -> np.ndarray:
        """Arrange what belongs to one plane as an image, the parameter across along columns.

        Args:
            index: of the plane.
            values: one per point.
        """
        chosen = values[self.points.family == index]
        return chosen.reshape(round(np.sqrt(len(chosen))), -1)


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        scenes: in the order of the catalogue.
    """

    settings: Settings
    scenes: list[SceneOutcome]

    @property
    def num_points(self) -> int:
        """Of all scenes, in one precision."""
        return sum(len(one.points) for one in self.scenes)

    def total(self, precision: str, question: str) -> int:
        """Count where something holds, over all scenes.

        Args:
            precision: of mjxgrad.
            question: a Boolean attribute of `Behaviour`.
        """
        return int(sum(getattr(one.behaviour[precision], question).sum() for one in self.scenes))

    def rows(self) -> list[dict[str, Any]]:
        """One row per point, for metrics.csv."""
        return [row for one in self.scenes for row in _rows(one, self.settings.precisions)]


def _ranks(motion: Int[np.ndarray, " points"]) -> Int[np.ndarray, " points"]:
    return np.array([kind.rank for kind in Motion])[motion]


def _rows(one: SceneOutcome, precisions: tuple[str, ...]) -> list[dict[str, Any]]:
    rows = []
    for i in range(len(one.points)):
        plane = one.points.family[i]
        row = {
            "scene": one.scene.name,
            "plane": RANDOM if plane < 0 else " × ".join(one.points.planes[plane]),
            **one.points[i],
            "c_motion": Motion(one.behaviour[C_MUJOCO].motion[i]).label,
            "c_derivative": Derivative(one.behaviour[C_MUJOCO].derivative[i]).label,
        }
        for name in precisions:
            behaviour = one.behaviour[name]
            row |= {
                f"{name}_motion": Motion(behaviour.motion[i]).label,
                f"{name}_derivative": Derivative(behaviour.derivative[i]).label,
                f"{name}_derivative_by_parameters": _label(behaviour.by_parameters, i),
                f"{name}_event_derivative": _label(behaviour.event, i),
                f"{name}_silent": bool(behaviour.is_silent[i]),
                f"{name}_untold": bool(behaviour.is_untold[i]),
                f"{name}_gradient_unflagged_by_rollout": bool(behaviour.is_unflagged[i]),
                f"{name}_apart_from_c": float(one.apart[name][i]),
                f"{name}_energy": float(behaviour.gain[i]),
            }
        rows.append(row)
    return rows


def _label(values: Int[np.ndarray, " points"] | None, index: int) -> str:
    return "" if values is None else Derivative(values[index]).label
