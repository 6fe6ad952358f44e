"""What an experiment on leaving out can be told; imports nothing heavy."""

from typing import Literal

from experiments.settings import RunSettings, SettingsTable

SceneName = Literal[
    "ball_wall", "billiards", "cube_toss", "friction", "motion_planning", "planar_pusher", "push", "rolling_pin",
    "tennis", "two_bodies",
    "hopper", "half_cheetah", "walker2d", "swimmer", "reacher", "inverted_pendulum", "inverted_double_pendulum", "ant",
    "humanoid",
]  # fmt: skip


class Sizes(SettingsTable):
    """How much is measured."""

    scenes: tuple[SceneName, ...]
    """By name."""
    batch: int
    """Rollouts that are timed together."""
    horizon: int
    """Of each, in steps."""
    repeats: int
    """Of every timing."""
    num_recorded: int
    """Rollouts recorded for what motions reach, and as many others to check it on."""
    has_every_gradient: bool
    """Whether the gradient is measured of every group that makes another motion's program, or only of fixed bodies and of all
    that is left out together."""


class Settings(RunSettings):
    """What a step costs with everything, without each group of what it may not need, and without all of them."""

    size: Literal["quick", "default", "full"] = "default"
    """How much is measured: quick for a look, full for a GPU."""
    sizes: Sizes
    """The numbers that go with the size: those of the file's table of that name."""
    scenes: tuple[SceneName, ...] = ()
    """Which scenes; those of the size, if none is given."""

    @property
    def chosen(self) -> tuple[SceneName, ...]:
        """The scenes to measure."""
        return self.scenes or self.sizes.scenes
