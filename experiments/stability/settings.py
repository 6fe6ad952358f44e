"""What an experiment on stability can be told; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import RunSettings


@dataclass(frozen=True)
class Size:
    """How much of the grid is looked at.

    Attributes:
        resolution: points along each side of a plane.
        num_random: points of a Latin hypercube over all parameters of a scene.
        scenes: by name; None for all.
        event: scenes whose event gradient is looked at, too; None for all.
        chunk: rollouts that go through a program at once.
    """

    resolution: int
    num_random: int
    scenes: tuple[str, ...] | None
    event: tuple[str, ...] | None
    chunk: int


SIZES = {
    "quick": Size(8, 32, ("ball", "two balls, elliptic"), (), 128),
    "default": Size(
        12,
        256,
        (
            "ball",
            "ball, refsafe",
            "sphere, condim 1",
            "sphere, condim 3, pyramidal",
            "sphere, condim 3, elliptic",
            "sphere, condim 4, elliptic",
            "sphere, condim 6, pyramidal",
            "two balls, pyramidal",
            "two balls, elliptic",
            "stack",
            "box, pyramidal",
            "chain",
        ),
        ("ball", "two balls, pyramidal"),
        128,
    ),
    "full": Size(24, 2048, None, None, 4096),
}


class Settings(RunSettings):
    """Rollouts and their gradients over a grid of stiff and extreme cases, beside C MuJoCo."""

    size: Literal["quick", "default", "full"] = "default"
    """How fine the grid is, and how many scenes and gradients are looked at."""
    num_steps: Annotated[int, Field(ge=20, le=1000)] = 100
    """Of every rollout, whatever its time step."""
    onset: bool = False
    """Whether contacts begin within the step, in place of MuJoCo's motion with both its derivatives."""
    precisions: Annotated[tuple[Literal["float32", "float64"], ...], Field(min_length=1, max_length=2)] = (
        "float64",
        "float32",
    )
    """In which mjxgrad runs; C MuJoCo runs in float64."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.precision != "float64" or self.precisions[0] != "float64":
            raise ValueError(
                f"precisions must begin with float64, whose finite differences judge all, got {', '.join(self.precisions)}"
            )
        if len(set(self.precisions)) < len(self.precisions):
            raise ValueError(f"precisions must differ, got {', '.join(self.precisions)}")
        return self
