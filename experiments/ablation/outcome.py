"""The numbers of an experiment on leaving out, and what follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.ablation.settings import Settings
from experiments.ablation.variants import Variant
from mjxgrad.diagnostics import OmissionCheck

# Two programs round differently in every operation of every step, the moved start only once.
_ROUNDING_FACTOR = 100.0


@dataclass(frozen=True)
class Cost:
    """One program of one variant, beside the same one of the scene with everything."""

    seconds: Float[np.ndarray, " repeats"]  # of each run of the batch
    base_seconds: Float[np.ndarray, " repeats"]  # of the runs with everything, in the same turns
    compile_seconds: float  # to trace and compile
    base_compile_seconds: float  # likewise with everything
    flops: float  # of the program by XLA's count, a loop's body once
    base_flops: float  # likewise with everything
    is_same_program: bool  # whether the two are the same, letter for letter, before XLA compiles them
    difference: float  # largest, of any number that the programs give
    rounding: float  # largest that moving the start by a few roundings makes, with everything
    scale: float  # largest number that the program gives

    @property
    def ratio(self) -> tuple[float, float, float]:
        """Time as a share of that with everything: lower quartile, median, upper quartile over turns."""
        low, middle, high = np.quantile(self.seconds / self.base_seconds, [0.25, 0.5, 0.75])
        return float(low), float(middle), float(high)

    @property
    def is_unchanged(self) -> bool:
        """Whether nothing differs by more than rounding makes of it."""
        return self.difference <= _ROUNDING_FACTOR * max(self.rounding, np.finfo(float).eps * self.scale)

    @property
    def verdict(self) -> str:
        """Say in a word or two whether numbers are those with everything."""
        if self.is_same_program:
            return "same program"
        if self.difference == 0.0:
            return "equal"
        return "to rounding" if self.is_unchanged else f"differs by {self.difference / self.scale:.1e}"


@dataclass(frozen=True)
class VariantOutcome(Variant):
    """What a variant costs."""

    step: Cost  # cost of the motion
    gradient: Cost | None  # cost of its gradient; None if not measured
    # What the full model says of the motions from which it was told what is not reached, and of other motions of the kind;
    # empty where a group alone is left out.
    checks: Sequence[OmissionCheck]

    @property
    def costs(self) -> list[Cost]:
        """Of the motion and, where measured, of its gradient."""
        return [self.step, self.gradient] if self.gradient else [self.step]

    @property
    def is_same_program(self) -> bool:
        """Whether XLA is given what it is given with everything."""
        return all(cost.is_same_program for cost in self.costs)

    @property
    def is_unchanged(self) -> bool:
        """Whether motion and, where measured, gradient are those with everything."""
        return all(cost.is_unchanged for cost in self.costs)


@dataclass(frozen=True)
class SceneOutcome:
    """All variants of a scene, the one with everything first, and the steps of one run of a program, over its batch."""

    name: str
    variants: list[VariantOutcome]
    steps_per_run: int

    def find(self, name: str) -> VariantOutcome | None:
        """Give a variant by its name; None if the scene has none."""
        return next((variant for variant in self.variants if variant.name == name), None)


@dataclass(frozen=True)
class Outcome:
    """All that was measured, in the order of the settings."""

    settings: Settings
    scenes: list[SceneOutcome]

    def rows(self) -> list[dict[str, Any]]:
        """One row per scene and variant, for metrics.csv; the first, with everything, has every column."""
        rows = []
        for scene in self.scenes:
            for variant in scene.variants:
                row: dict[str, Any] = {
                    "scene": scene.name,
                    "left_out": variant.name,
                    "what": variant.what,
                    "pairs": len(variant.scene.pairs),
                    "rows": variant.num_rows,
                    "bodies": int(variant.scene.model.nbody),
                }
                missed = [len(check.missed) for check in variant.checks] or ("", "")
                row |= dict(zip(("missed_recorded", "missed_others"), missed, strict=True))
                for word, cost in zip(("step", "gradient"), variant.costs, strict=False):
                    low, middle, high = cost.ratio
                    row |= {
                        f"{word}_microseconds": 1e6 * float(np.median(cost.seconds)) / scene.steps_per_run,
                        f"{word}_ratio_low": low,
                        f"{word}_ratio": middle,
                        f"{word}_ratio_high": high,
                    }
                    parts = ("compile_seconds", "flops", "difference", "rounding", "scale")
                    row |= {f"{word}_{part}": getattr(cost, part) for part in parts}
                rows.append(row)
        return rows
