"""What an experiment on error against run time can be told; imports nothing heavy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.settings import OwnScene, SettingsTable, SizedSettings

SceneName = Literal[
    "pendulum", "bounce", "slide", "cube", "arm", "hopper", "half_cheetah", "push", "heap", "walker2d", "ant"
]
_Share = Annotated[float, Field(gt=0, lt=1)]


class Sizes(SettingsTable):
    """How much is measured."""

    scenes: tuple[SceneName, ...]  # by name
    refinements: tuple[float, ...]  # by what a scene's own time step is divided, coarse to fine
    batch: int  # starts that are simulated together, and over which the error is taken
    # Simulated for the gradient, from which samples are drawn; a multiple of 8 times the batch or a divisor of it.
    num_rollouts: int
    num_samples: tuple[int, ...]  # of an estimate
    gradient_refinements: tuple[float, ...]  # as `refinements`, of gradients
    repeats: int  # at most, of every timing
    seconds: float  # after which a timing is not repeated again, once it has been repeated


class Settings(OwnScene, SizedSettings):
    """Error of motions and gradients against the time that they take, by scene."""

    sizes: Sizes
    # Which scenes, in place of those of the size; `scene`, one's own, takes the place of all.
    scenes: Annotated[tuple[SceneName, ...], Field(min_length=1)] | None = None
    # Relative errors for which a setting is recommended.
    targets: Annotated[tuple[_Share, ...], Field(min_length=1, max_length=3)] = (0.05, 1e-3)

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.precision != "float64":
            raise ValueError("precision must be float64: both precisions are compared within the run")
        if self.cost is not None:
            raise ValueError("cost: none here, where errors are of final positions, the only ones that are kept")
        return self
