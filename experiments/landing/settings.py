"""What an experiment on impacts can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.config import Positive, RunSettings

CaseName = Literal[
    "hopper",
    "walker2d",
    "half_cheetah",
    "ant",
    "ball_frictionless",
    "ball",
    "ball_elliptic",
    "ball_torsion",
    "ball_rolling",
    "ball_inclined",
    "ball_inclined_rolling",
    "two_balls",
    "two_balls_elliptic",
    "arm",
]


class LandingSettings(RunSettings):
    """Derivatives of motions with impacts against the slope of the simulated motion, over time."""

    cases: Annotated[tuple[CaseName, ...], Field(min_length=1)]
    """Which motions, each with its own contact, limits and integrator."""
    refinements: Annotated[tuple[Annotated[int, Field(ge=1, le=64)], ...], Field(min_length=1, max_length=6)] = (1, 2)
    """By what the motion's own time step is divided."""
    average_over: Literal["phases", "jitter"] = "phases"
    """What slope and means are averages over: the moved coordinate alone, or jitter of the rest of the start as well."""
    num_phases: Annotated[int, Field(ge=32)] = 48
    """Rollouts over the interval of the start, from which the slope and the means are taken; not under jitter."""
    num_samples: Annotated[int, Field(ge=32)] = 256
    """Jittered starts; without jitter unused."""
    position_stddev: Positive = 0.01
    """Of the jitter of joints beyond the moved body's own (rad or m)."""
    velocity_stddev: Positive = 0.05
    """Of the jitter of every velocity (rad/s or m/s)."""
    num_times: Annotated[int, Field(ge=2)] = 25
    """At which positions are compared, evenly over the motion."""
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """Error that a derivative may have, as a share of the larger of the slope and the discrete derivative's own error."""
