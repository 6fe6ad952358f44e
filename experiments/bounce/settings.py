"""What an experiment on bounces can be told; imports nothing heavy."""

from typing import Annotated

from pydantic import Field, model_validator

from experiments.settings import Positive, RunSettings, SettingsTable

Share = Annotated[float, Field(ge=0, lt=1)]


class ImpedanceSettings(SettingsTable):
    """The first three numbers of `solimp`."""

    first: Share
    """At the surface."""
    last: Annotated[float, Field(gt=0, lt=1)]
    """At depth `width`."""
    width: Positive = 0.001
    """Over which it rises, in m."""

    @property
    def numbers(self) -> tuple[float, float, float]:
        return self.first, self.last, self.width

    @property
    def label(self) -> str:
        if self.first == self.last:
            return f"{self.first:g} throughout"
        return f"{self.first:g} to {self.last:g} in {1e3 * self.width:g} mm"


class Settings(RunSettings):
    """Derivatives of a bounce over contact parameters and time steps, with the closed form."""

    damping_ratios: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=8)]
    """Second number of `solref`."""
    time_constants: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=8)]
    """First number of `solref`, in s."""
    impedances: Annotated[tuple[ImpedanceSettings, ...], Field(min_length=1, max_length=8)]
    """Of `solimp`."""
    timesteps: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=10)]
    """In s, increasing."""
    num_phases: Annotated[int, Field(ge=32)] = 64
    """Start heights over which the slope and the means are taken."""
    heights: tuple[Positive, Positive] = (0.01, 0.05)
    """Between which the ball starts, in m above the floor."""
    duration: Positive = 0.2
    """After which its height is read, in s; it flies at 1 m/s."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if list(self.timesteps) != sorted(set(self.timesteps)):
            raise ValueError(f"timesteps must increase, got {list(self.timesteps)}")
        if not self.heights[0] < self.heights[1]:
            raise ValueError(f"heights must be two numbers, the smaller one first, got {list(self.heights)}")
        if self.heights[1] >= self.duration:
            raise ValueError("duration must be longer than heights[1] / (1 m/s), when the last ball lands")
        return self
