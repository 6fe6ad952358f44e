"""What an experiment on long horizons can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import RunSettings, SettingsTable

ProblemName = Literal["double_pendulum", "hopper"]


class Sizes(SettingsTable):
    """What a size of the experiment stands for."""

    problems: tuple[ProblemName, ...]
    """By name."""
    num_times: int
    """At which the horizon may end."""
    num_repeats: int
    """Of every estimate."""
    num_samples: int
    """Rollouts of an estimate."""
    num_reference: int
    """Rollouts of the reference."""
    num_jacobians: int
    """Rollouts whose Jacobians are multiplied."""
    num_adaptive: int
    """Times up to which the pendulum is integrated with error control."""
    batch: int
    """Rollouts of a call, so that one compilation serves all."""


class Settings(RunSettings):
    """Error of first- and zeroth-order estimates against the horizon, its cause, and windows."""

    size: Literal["quick", "default", "full"] = "default"
    """How many horizons, repeats and samples."""
    sizes: Sizes
    """The numbers that go with the size: those of the file's table of that name."""
    problems: Annotated[tuple[ProblemName, ...], Field(min_length=1, max_length=2)] | None = None
    """To take, in place of those of the size."""
    confidence: Annotated[float, Field(gt=0.5, lt=1)] = 0.95
    """Of every interval."""
