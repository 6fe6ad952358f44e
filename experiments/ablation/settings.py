"""What an experiment on leaving out can be told; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pydantic import Field

from experiments.settings import RunSettings

SceneName = Literal[
    "ball_wall", "billiards", "cube_toss", "friction", "motion_planning", "planar_pusher", "push", "rolling_pin",
    "tennis", "two_bodies",
    "hopper", "half_cheetah", "walker2d", "swimmer", "reacher", "inverted_pendulum", "inverted_double_pendulum", "ant",
    "humanoid",
]  # fmt: skip
_SOME: tuple[SceneName, ...] = ("two_bodies", "motion_planning", "hopper", "reacher", "ant")
# The humanoid takes about as long as all others together, so it is left to who asks for it by name.
_MOST: tuple[SceneName, ...] = tuple(name for name in get_args(SceneName) if name != "humanoid")


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        scenes: by name.
        batch: rollouts that are timed together.
        horizon: of each, in steps.
        repeats: of every timing.
        num_recorded: rollouts recorded for what motions reach, and as many others to check it on.
        has_every_gradient: whether the gradient is measured of every group that makes another motion's program, or only of fixed
            bodies and of all that is left out together.
    """

    scenes: tuple[SceneName, ...]
    batch: int
    horizon: int
    repeats: int
    num_recorded: int
    has_every_gradient: bool


SIZES = {
    "quick": Sizes(("two_bodies", "reacher", "inverted_pendulum"), 32, 10, 5, 8, False),
    "default": Sizes(_SOME, 64, 20, 7, 16, False),
    "full": Sizes(_MOST, 1024, 20, 9, 64, True),
}


class Settings(RunSettings):
    """What a step costs with everything, without each group of what it may not need, and without all of them."""

    size: Literal["quick", "default", "full"] = "default"
    """How much is measured: quick for a look, full for a GPU."""
    scenes: tuple[SceneName, ...] = ()
    """Which scenes; those of the size, if none is given."""
    duration: Annotated[float, Field(gt=0)] = 1.0
    """Of each recorded rollout (s)."""
    control_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Of the range of the controls, over which they are drawn for the recorded rollouts."""
    beyond_limits: Annotated[float, Field(ge=0)] = 0.1
    """How far joints may leave their ranges in a proof that geoms never touch (rad or m)."""

    @property
    def sizes(self) -> Sizes:
        """The numbers that go with the size."""
        return SIZES[self.size]

    @property
    def chosen(self) -> tuple[SceneName, ...]:
        """The scenes to measure."""
        return self.scenes or self.sizes.scenes
