"""The numbers of an experiment on stability."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from experiments.stability.classes import Derivative, Motion
from experiments.stability.scenes import Points, StabilityScene
from experiments.stability.settings import Settings

C_MUJOCO = "C MuJoCo"
NOT_ASKED = -1
"""In the place of a value of `Derivative` that was not asked for."""
_KINDS = {
    "motion": Motion,
    "derivative": Derivative,
    "derivative_by_parameters": Derivative,
    "event_derivative": Derivative,
}


@dataclass(frozen=True)
class SceneOutcome:
    """One scene."""

    scene: StabilityScene  # of the catalogue
    points: Points  # of its grid
    # By simulator (`C_MUJOCO`, and mjxgrad by its precision) and point: `motion`, of `Motion`; of `Derivative` that of the
    # discrete gradient along a change of the start (`derivative`) and of the model's parameters
    # (`derivative_by_parameters`), and that of the event gradient (`event_derivative`); whether numbers that are not finite
    # left the rollout without a flag (`silent`), whether some step is not solved and `Trajectory.unsolved` is zero
    # (`untold`), whether the gradient is not finite or explodes where `Trajectory.diverged` is false
    # (`gradient_unflagged_by_rollout`), and `soundness` finds nothing wrong either (`missed`); difference of the final
    # positions from those of C MuJoCo over what a body flies (`apart_from_c`), and largest kinetic energy over what there
    # was to draw on (`energy`).
    found: xr.Dataset


@dataclass(frozen=True)
class Outcome:
    """All that was measured, the scenes in the order of the catalogue."""

    settings: Settings
    scenes: list[SceneOutcome]

    @functools.cached_property
    def found(self) -> xr.Dataset:
        """The points of all scenes, one after another."""
        return xr.concat([one.found for one in self.scenes], "point")

    def rows(self) -> list[dict[str, Any]]:
        """One row per point, for metrics.csv."""
        return [row for one in self.scenes for row in _rows(one)]


def against_c(found: xr.Dataset, precision: str) -> np.ndarray:
    """Compare mjxgrad's motion with that of C MuJoCo: above 0 where it is of a worse kind, below where of a better one."""
    # All that are fine have one rank.
    ranks = np.maximum(found.motion, Motion.BOUNCES_RIGHT)
    return (ranks.sel(simulator=precision) - ranks.sel(simulator=C_MUJOCO)).values


def _rows(one: SceneOutcome) -> list[dict[str, Any]]:
    columns: dict[str, Any] = {}
    for name in one.found.simulator.values:
        of_one = one.found.sel(simulator=name)
        keys = [key for key in of_one.data_vars if key != "missed"] if name != C_MUJOCO else ["motion", "derivative"]
        prefix = "c" if name == C_MUJOCO else name
        columns |= {f"{prefix}_{key}": _readable(str(key), of_one[key].values) for key in keys}
    planes = ["random" if i < 0 else " × ".join(one.points.planes[i]) for i in one.points.family]
    return [
        {
            "scene": one.scene.name,
            "plane": plane,
            **one.points[i],
            **{key: values[i] for key, values in columns.items()},
        }
        for i, plane in enumerate(planes)
    ]


def _readable(key: str, values: np.ndarray) -> list[Any]:
    if key not in _KINDS:
        return values.tolist()
    return ["" if value == NOT_ASKED else _KINDS[key](value).label for value in values]
