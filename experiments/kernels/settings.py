"""What an experiment on smoothing kernels can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import Positive, RunSettings

KernelName = Literal["gaussian", "logistic", "log_barrier"]


class Settings(RunSettings):
    """Force at a distance, the noise it stands for, and motion and derivatives against samples of that noise."""

    kernels: Annotated[tuple[KernelName, ...], Field(min_length=1, max_length=3)]
    """To compare."""
    length: Positive
    """Of the noise, in m."""
    impedance: Annotated[float, Field(gt=1e-4, lt=1)]
    """Of the moving scene, the same at every depth."""
    time_constant: Positive
    """First number of `solref`, in s; the second is 1."""
    timestep: Positive
    """In s."""
    speed: Positive
    """Towards the plane, in m/s."""
    start: Positive
    """Distance at which the motion begins, in m."""
    horizon: Annotated[int, Field(ge=10)]
    """Steps of the motion."""
    num_rollouts: Annotated[int, Field(ge=10)]
    """With noise drawn afresh in each step."""
    num_samples: Annotated[int, Field(ge=100)]
    """Of single steps."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if len(set(self.kernels)) < len(self.kernels):
            raise ValueError(f"kernels must differ, got {', '.join(self.kernels)}")
        if self.timestep > 0.25 * self.time_constant:
            raise ValueError(f"timestep must be at most a quarter of time_constant, got {self.timestep:g}")
        return self
