"""What a bias and variance experiment can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import Finite, Positive, RunSettings, VideoSettings


class ThrowsSettings(VideoSettings):
    """Rollouts side by side: each of some angles at each of some stiffnesses."""

    angles: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=4)]
    """One column each, in rad."""
    stiffness: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=3)]
    """One row each, in 1/s²."""


class Settings(RunSettings):
    """Bias and variance of both estimates against contact stiffness, at several points."""

    task: Literal["ball_wall", "ramp"]
    """What is differentiated."""
    stddev: Annotated[float, Field(ge=1e-9, allow_inf_nan=False)]
    """Of the noise on the angle, in rad (on the ramp without a unit)."""
    angles: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=6)]
    """Where gradients are estimated, in rad."""
    stiffness: Annotated[tuple[Positive, ...], Field(min_length=2)]
    """Contact stiffness to sweep, in 1/s² (for the ramp its slope, without a unit)."""
    damping_ratio: Positive = 1.0
    """Of the contacts, the same at every stiffness; 1 is critical."""
    include_default: bool = True
    """Whether the scene's own softness joins the sweep, and is marked."""
    num_samples: Annotated[int, Field(ge=2)]
    """Rollouts per estimate."""
    reference_samples: Annotated[int, Field(ge=100)]
    """Rollouts per stiffness for the landscape, from which the reference is taken."""
    rollouts_per_gradient: Annotated[int, Field(ge=1)] = 100
    """The budget for which the report says which estimate to use."""
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.95
    """Of every interval."""
    video: ThrowsSettings | None = None
