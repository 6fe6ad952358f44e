"""What an experiment on stability can be told; imports nothing heavy."""

from typing import Annotated

from pydantic import Field, model_validator

from experiments.settings import Precision, SettingsTable, SizedSettings


class Sizes(SettingsTable):
    """How much of the grid is looked at."""

    resolution: int  # points along each side of a plane
    num_random: int  # points of a Latin hypercube over all parameters of a scene
    scenes: tuple[str, ...] | None = None  # by name; None for all
    chunk: int  # rollouts that go through a program at once


class Settings(SizedSettings):
    """Rollouts and their gradients over a grid of stiff and extreme cases, beside C MuJoCo."""

    sizes: Sizes
    num_steps: Annotated[int, Field(ge=20, le=1000)] = 100  # of every rollout, whatever its time step
    # In which mjxgrad runs; C MuJoCo runs in float64.
    precisions: Annotated[tuple[Precision, ...], Field(min_length=1, max_length=2)] = ("float64", "float32")

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.precision != "float64" or self.precisions[0] != "float64":
            raise ValueError(
                f"precisions must begin with float64, whose finite differences judge all, got {', '.join(self.precisions)}"
            )
        return self
