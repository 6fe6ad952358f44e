"""What a planning experiment can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import Finite, Positive, RunSettings, SettingsTable, VideoSettings

Count = Annotated[int, Field(ge=1)]

NAMES = {
    "analytic": "analytic",
    "mean_jacobian": "mean Jacobians",
    "least_squares": "least squares",
    "none": "no smoothing",
}


class TreeSettings(SettingsTable):
    """How a tree is grown."""

    capacity: Annotated[int, Field(ge=200)] = 4000
    """Nodes at most."""
    num_seeds: Count = 3
    """Trees for each kind of linear model."""
    position_tolerance: Positive = 0.02
    """How near the rod must come to its goal (m)."""
    angle_tolerance: Positive = 0.15
    """Likewise its turn (rad)."""
    polish_iterations: Annotated[int, Field(ge=0)] = 0
    """Iterations of trajectory optimisation on the shortest way found. A way of many pushes is easily lost under smoothing:
    then nothing is gained, and the way stays as it was."""


class Settings(RunSettings):
    """A rod is pushed to a pose by a finger that does not touch it at the start."""

    method: Literal["trajectory", "tree"]
    """Trajectory optimisation from resting controls, or a search tree."""
    models: Annotated[
        tuple[Literal["analytic", "mean_jacobian", "least_squares", "none"], ...], Field(min_length=1)
    ] = ("analytic", "none")
    """Which linear models to compare; the first is the one that figures and video show."""
    finger: tuple[Finite, Finite] = (0.0, -0.15)
    """Where the finger starts (m)."""
    goal: tuple[Finite, Finite, Finite]
    """Where the rod is to be: x, y (m) and turn (rad); it starts at the origin."""
    length: Positive = 0.05
    """Smoothing of contacts at the start (m); the tree keeps it."""
    last_length: Positive = 0.001
    """Smoothing of contacts in the last iterations of a trajectory (m)."""
    num_samples: Annotated[int, Field(ge=14)] = 24
    """Per linear model, where it is sampled."""
    num_iterations: Annotated[int, Field(ge=3)] = 60
    """Of trajectory optimisation."""
    horizon: Count = 25
    """Decisions of 0.1 s each."""
    tree: TreeSettings = TreeSettings()
    """If the method is a tree."""
    video: VideoSettings | None = None
    """Without it, none is made."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.last_length > self.length:
            raise ValueError("last_length must be at most length: smoothing decreases")
        return self
