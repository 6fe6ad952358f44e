"""What a bias and variance experiment can be told; imports nothing heavy."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import Confidence, Finite, OwnScene, Positive, RunSettings, Several, VideoSettings


class ThrowsSettings(VideoSettings):
    """Rollouts side by side: each of some angles at each of some stiffnesses."""

    angles: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=4)]  # one column each, in rad
    stiffness: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=3)]  # one row each, in 1/s²


class Settings(OwnScene, RunSettings):
    """Bias and variance of both estimates against contact stiffness, at several points."""

    task: Literal["ball_wall", "ramp"] | None = None  # what is differentiated; a scene of one's own takes its place
    # Of the noise on the angle, in rad (on the ramp without a unit; of an own scene on each control at each step, in
    # halves of its range, or without actuators on velocities at the start).
    stddev: Annotated[float, Field(ge=1e-9, allow_inf_nan=False)]
    # Where gradients are estimated, in rad (of an own scene a constant control, or a velocity, along one direction).
    angles: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=6)]
    # Contact stiffness to sweep, in 1/s² (for the ramp its slope, without a unit).
    stiffness: Annotated[tuple[Positive, ...], Field(min_length=2)]
    damping_ratio: Positive = 1.0  # of the contacts, the same at every stiffness; 1 is critical
    include_default: bool = True  # whether the scene's own softness joins the sweep, and is marked
    num_samples: Several  # rollouts per estimate
    # Rollouts per stiffness for the landscape, from which the reference is taken.
    reference_samples: Annotated[int, Field(ge=100)]
    # The budget for which the report says which estimate to use.
    rollouts_per_gradient: Annotated[int, Field(ge=1)] = 100
    confidence: Confidence = 0.95  # of every interval
    video: ThrowsSettings | None = None  # of the throws of `ball_wall`

    @property
    def problem(self) -> str:
        """Give what is differentiated."""
        return "own" if self.scene else str(self.task)

    @model_validator(mode="after")
    def _has_problem(self) -> "Settings":
        if self.task is None and self.scene is None:
            raise ValueError("task: required where there is no scene, and missing")
        if self.problem == "ball_wall" and (far := [x for x in self.angles if abs(x) > math.tau]):
            raise ValueError(f"angles: must be in rad, within a turn, got {far[0]:g}")
        return self
