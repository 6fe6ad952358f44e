"""What an experiment on error against run time can be told; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.parallel import num_cores
from experiments.settings import Positive, RunSettings

SceneName = Literal[
    "pendulum", "bounce", "slide", "cube", "arm", "hopper", "half_cheetah", "push", "heap", "walker2d", "ant"
]
_DEFAULT_SCENES: tuple[SceneName, ...] = ("pendulum", "bounce", "slide", "cube", "arm", "hopper", "push", "heap")


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        scenes: by name.
        with_asides: scenes in which a state alone, MJX in double precision and the other cone are looked at, too; None for
            all. Each is one more program to compile.
        refinements: by what a scene's own time step is divided, coarse to fine.
        tolerances: of the solver, beside the tight one of every other run.
        batch: starts that are simulated together, and over which the error is taken.
        num_rollouts: simulated for the gradient, from which samples are drawn; a multiple of 8 times the batch or a
            divisor of it.
        num_samples: of an estimate.
        gradient_refinements: as `refinements`, of gradients.
        softenings: factors on the contacts' time constant, beside 1.
        repeats: at most, of every timing.
        seconds: after which a timing is not repeated again, once it has been repeated.
        has_all_variants: whether MJX is run with every integrator, mg.step in single precision with more, and with few
            iterations.
    """

    scenes: tuple[SceneName, ...]
    with_asides: tuple[SceneName, ...] | None
    refinements: tuple[float, ...]
    tolerances: tuple[float, ...]
    batch: int
    num_rollouts: int
    num_samples: tuple[int, ...]
    gradient_refinements: tuple[float, ...]
    softenings: tuple[float, ...]
    repeats: int
    seconds: float
    has_all_variants: bool


SIZES = {
    "quick": Sizes(
        ("pendulum", "push"), None, (0.5, 1.0, 2.0, 4.0), (1e-2,), 32, 128, (8, 32), (1.0, 2.0), (2.0,), 3, 0.1, False
    ),
    "default": Sizes(
        _DEFAULT_SCENES, ("pendulum", "bounce"), (0.5, 1.0, 2.0, 4.0, 8.0), (1e-2, 1e-4, 1e-6), 32, 256,
        (8, 32, 128), (0.5, 1.0), (2.0, 4.0), 5, 0.4, False,
    ),
    "full": Sizes(
        (*_DEFAULT_SCENES, "half_cheetah", "walker2d", "ant"), None, (0.5, 1.0, 2.0, 4.0, 8.0),
        (1e-2, 1e-4, 1e-6), 1024, 4096, (8, 32, 128, 512), (0.5, 1.0, 2.0, 4.0), (2.0, 4.0, 8.0), 5, 1.0, True,
    ),
}  # fmt: skip


class Settings(RunSettings):
    """Error of motions and gradients against the time that they take, by scene."""

    size: Literal["quick", "default", "full"] = "default"
    """How much is measured: two scenes in a minute or two, eight in a quarter of an hour on two cores, all on a GPU."""
    scenes: tuple[SceneName, ...] | None = None
    """Which scenes, in place of those of the size."""
    targets: Annotated[tuple[Annotated[float, Field(gt=0, lt=1)], ...], Field(min_length=1, max_length=3)] = (
        0.05,
        1e-3,
    )
    """Relative errors for which a setting is recommended."""
    threads: Annotated[int, Field(ge=1, le=256)] | None = None
    """Of C MuJoCo's rollout; one for every core, if none is given."""
    tight_tolerance: Positive = 1e-8
    """Of the solver where tolerance is not what is varied; in single precision at least 1e-6, which is what it resolves."""

    @property
    def sizes(self) -> Sizes:
        """Give the numbers that the size stands for."""
        return SIZES[self.size]

    @property
    def scene_names(self) -> tuple[SceneName, ...]:
        """Give the scenes to run."""
        return self.sizes.scenes if self.scenes is None else self.scenes

    @property
    def num_threads(self) -> int:
        """Give the number of threads of C MuJoCo's rollout."""
        return self.threads or num_cores()

    def has_asides(self, name: str) -> bool:
        """Say whether a scene is looked at in every way that the size has."""
        return self.sizes.with_asides is None or name in self.sizes.with_asides

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.precision != "float64":
            raise ValueError("precision must be float64: both precisions are compared within the run")
        if self.scenes is not None and not self.scenes:
            raise ValueError("scenes must name at least one scene, got none")
        if self.scenes is not None and len(set(self.scenes)) < len(self.scenes):
            raise ValueError(f"scenes must not repeat, got {list(self.scenes)}")
        return self
