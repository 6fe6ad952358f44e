"""What the experiment on the thrown cube can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import Positive, RunSettings


class Settings(RunSettings):
    """Error of a derivative against processor time, for time steps and methods."""

    contacts: Annotated[tuple[Literal["published", "default"], ...], Field(min_length=1)] = ("published", "default")
    """Of the cube with the floor: as DiffMJX published it, whose force begins continuously, or MuJoCo's default."""
    timesteps: Annotated[tuple[Positive, ...], Field(min_length=2)]
    """For discrete and event gradients and contact that begins within the step, in s; each must divide a second."""
    refined_timesteps: Annotated[tuple[Positive, ...], Field(min_length=1)]
    """For short steps at events, in s."""
    tolerances: Annotated[tuple[Positive, ...], Field(min_length=1)]
    """Of the adaptive integration."""
