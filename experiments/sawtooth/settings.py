"""What an experiment on the sawtooth can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import Positive, RunSettings

RobotName = Literal["hopper", "walker2d", "half_cheetah", "ant"]
BallName = Literal["ball_frictionless", "ball", "ball_elliptic", "ball_torsion", "ball_rolling"]
OtherName = Literal["ball_inclined", "ball_inclined_rolling", "two_balls", "two_balls_elliptic", "arm"]


class Settings(RunSettings):
    """Outcomes of motions with impacts, and their derivatives, over where within a time step the impact falls."""

    cases: Annotated[tuple[Literal[RobotName, BallName, OtherName], ...], Field(min_length=1)]
    """Which motions, each with its own contact, limits and integrator."""
    timesteps: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.002,)
    """In s, besides the motion's own."""
    num_phases: Annotated[int, Field(ge=64)] = 192
    """Starts over the interval."""
    reference: Annotated[int, Field(ge=0, le=64)] = 0
    """By what the time step is divided for MuJoCo's converged motion; 0 leaves that comparison out."""
