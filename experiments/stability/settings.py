"""What an experiment on stability can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import RunSettings, SettingsTable


class Sizes(SettingsTable):
    """How much of the grid is looked at."""

    resolution: int
    """Points along each side of a plane."""
    num_random: int
    """Points of a Latin hypercube over all parameters of a scene."""
    scenes: tuple[str, ...] | None = None
    """By name; None for all."""
    chunk: int
    """Rollouts that go through a program at once."""


class Settings(RunSettings):
    """Rollouts and their gradients over a grid of stiff and extreme cases, beside C MuJoCo."""

    size: Literal["quick", "default", "full"] = "default"
    """How fine the grid is, and how many scenes and gradients are looked at."""
    sizes: Sizes
    """The numbers that go with the size: those of the file's table of that name."""
    num_steps: Annotated[int, Field(ge=20, le=1000)] = 100
    """Of every rollout, whatever its time step."""
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
        return self
