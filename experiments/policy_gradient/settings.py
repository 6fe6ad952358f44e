"""What an experiment on policy gradients can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import Positive, RunSettings

TaskName = Literal["ball_wall", "ball_wall_default", "push_soft", "push_stiff", "hopper"]
Angle = Annotated[float, Field(gt=0, lt=1.5)]


class Settings(RunSettings):
    """Both gradients of each task against an unbiased reference, and what α-order makes of them."""

    tasks: Annotated[tuple[TaskName, ...], Field(min_length=1)]
    """Which tasks; `ball_wall_default` has MuJoCo's default contact in place of the scene's own."""
    angles: Annotated[tuple[Angle, ...], Field(min_length=1)]
    """Of the throws at which gradients are compared, in rad."""
    angle_stddev: Positive
    """Noise on the angle there, in rad."""
    num_estimates: Annotated[int, Field(ge=8)]
    """Independent estimates of each kind at each point, from which means and errors are taken."""
    num_references: Annotated[int, Field(ge=8)]
    """Further estimates, all unbiased, behind the reference."""
