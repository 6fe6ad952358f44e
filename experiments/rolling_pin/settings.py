"""What the rolling pin's experiment can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import Positive, RunSettings, SettingsTable, VideoSettings


class RemedySettings(SettingsTable):
    """How far each remedy reaches at first; all but proximity shrink on the way."""

    proximity: Positive = 0.3
    """Weight of the mean square of the distance to the bed, in distances at the start."""
    radius: Positive = 0.03
    """By which the pin is larger (m)."""
    margin: Positive = 0.03
    """At which force begins (m)."""
    rest_acceleration: Positive = 50.0
    """Under which a margin changes no depth (m/s²): about 8 N on a pillar of the bed."""
    length: Positive = 0.015
    """Standard deviation of the noise that kernels average over (m)."""
    last: Annotated[float, Field(gt=0, le=1)] = 0.02
    """What is left of radius, margin and length in the end, as a share."""


class Settings(RunSettings):
    """A dent in a bed that the pin does not touch, by descent along different derivatives."""

    num_steps: Annotated[int, Field(ge=2)] = 60
    """Of descent."""
    num_samples: Annotated[int, Field(ge=2)] = 2
    """Rollouts per step with derivatives."""
    learning_rate: Positive = 0.03
    """Of Adam."""
    stddev: Positive = 0.01
    """Of the noise on the controls of the remedies: so little that no sample finds the bed by it (10 N)."""
    search_stddev: Positive = 0.3
    """Of the noise by which zeroth order and α-order search, white in time (10 N)."""
    search_samples: Annotated[int, Field(ge=4)] = 16
    """Rollouts per step of these."""
    kernel: Literal["gaussian", "logistic", "log_barrier"] = "gaussian"
    """Of the smoothing."""
    solved_below: Positive = 0.1
    """True cost that counts as solved; the untouched bed has 1."""
    remedies: RemedySettings = RemedySettings()
    """Their reach."""
    video: VideoSettings | None = None
    """Without it, none is made."""
