"""What an experiment on long horizons can be told; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from experiments.settings import RunSettings

ProblemName = Literal["double_pendulum", "hopper"]
_PROBLEMS: tuple[ProblemName, ...] = ("double_pendulum", "hopper")


@dataclass(frozen=True)
class Sizes:
    """What a size of the experiment stands for.

    Attributes:
        problems: by name.
        num_times: at which the horizon may end.
        num_repeats: of every estimate.
        num_samples: rollouts of an estimate.
        num_reference: rollouts of the reference.
        num_jacobians: rollouts whose Jacobians are multiplied.
        num_adaptive: times up to which the pendulum is integrated with error control.
        batch: rollouts of a call, so that one compilation serves all.
    """

    problems: tuple[ProblemName, ...]
    num_times: int
    num_repeats: int
    num_samples: int
    num_reference: int
    num_jacobians: int
    num_adaptive: int
    batch: int


SIZES = {
    "quick": Sizes(("hopper",), 16, 16, 8, 512, 8, 4, 128),
    "default": Sizes(_PROBLEMS, 32, 32, 16, 4096, 16, 12, 256),
    "full": Sizes(_PROBLEMS, 48, 64, 128, 131072, 64, 24, 8192),
}


class Settings(RunSettings):
    """Error of first- and zeroth-order estimates against the horizon, its cause, and windows."""

    size: Literal["quick", "default", "full"] = "default"
    """How many horizons, repeats and samples."""
    problems: Annotated[tuple[ProblemName, ...], Field(min_length=1, max_length=2)] | None = None
    """To take, in place of those of the size."""
    confidence: Annotated[float, Field(gt=0.5, lt=1)] = 0.95
    """Of every interval."""

    @property
    def sizes(self) -> Sizes:
        """What the size stands for."""
        return SIZES[self.size]
