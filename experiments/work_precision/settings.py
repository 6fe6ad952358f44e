"""What an experiment on error against run time can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import OwnScene, RunSettings, SettingsTable

SceneName = Literal[
    "pendulum", "bounce", "slide", "cube", "arm", "hopper", "half_cheetah", "push", "heap", "walker2d", "ant"
]


class Sizes(SettingsTable):
    """How much is measured."""

    scenes: tuple[SceneName, ...]
    """By name."""
    refinements: tuple[float, ...]
    """By what a scene's own time step is divided, coarse to fine."""
    batch: int
    """Starts that are simulated together, and over which the error is taken."""
    num_rollouts: int
    """Simulated for the gradient, from which samples are drawn; a multiple of 8 times the batch or a divisor of it."""
    num_samples: tuple[int, ...]
    """Of an estimate."""
    gradient_refinements: tuple[float, ...]
    """As `refinements`, of gradients."""
    repeats: int
    """At most, of every timing."""
    seconds: float
    """After which a timing is not repeated again, once it has been repeated."""


class Settings(OwnScene, RunSettings):
    """Error of motions and gradients against the time that they take, by scene."""

    size: Literal["quick", "default", "full"] = "default"
    """How much is measured: two scenes in a minute or two, eight in a quarter of an hour on two cores, all on a GPU."""
    sizes: Sizes
    """The numbers that go with the size: those of the file's table of that name."""
    scenes: Annotated[tuple[SceneName, ...], Field(min_length=1)] | None = None
    """Which scenes, in place of those of the size; `scene`, one's own, takes the place of all."""
    targets: Annotated[tuple[Annotated[float, Field(gt=0, lt=1)], ...], Field(min_length=1, max_length=3)] = (
        0.05,
        1e-3,
    )
    """Relative errors for which a setting is recommended."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.precision != "float64":
            raise ValueError("precision must be float64: both precisions are compared within the run")
        if self.cost is not None:
            raise ValueError("cost: none here, where errors are of final positions, the only ones that are kept")
        return self
