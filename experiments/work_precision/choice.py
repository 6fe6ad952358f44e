"""What to take for a wanted error."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.work_precision.outcome import Estimate, Point


def fastest(points: Iterable[Point], target: float) -> Point | None:
    """Give the fastest point from which on its line stays below an error; None if there is none.

    One coarse point that is right by luck, between finer ones that are not, does not count.

    Args:
        points: of one scene.
        target: error.

    Returns:
        The point.
    """
    lines: dict[tuple[Any, ...], list[Point]] = {}
    for point in points:
        lines.setdefault(point.line, []).append(point)
    found = []
    for line in lines.values():
        for point in sorted(line, key=lambda one: one.knob):
            if not point.error <= target:
                break
            found.append(point)
    return min(found, key=lambda one: one.cost, default=None)


@dataclass(frozen=True)
class Choice:
    """What to take for a gradient.

    Attributes:
        estimate: the way.
        num_samples: that it needs.
        seconds: that one estimate then takes.
    """

    estimate: Estimate
    num_samples: float
    seconds: float


def cheapest(estimates: Iterable[Estimate], target: float) -> Choice | None:
    """Give the estimate that reaches an error in the least time, its samples made as many as that takes.

    Args:
        estimates: of one scene; of those that differ in the number of samples alone the largest speaks, for it knows its
            bias best.
        target: error.

    Returns:
        The choice; None if every bias is beyond the target.
    """
    largest: dict[tuple[Any, ...], Estimate] = {}
    for one in sorted(estimates, key=lambda one: one.num_samples):
        largest[one.line] = one
    choices = []
    for one in largest.values():
        count = one.samples_for(target)
        # A bias is not known better than this: what chance could hide of it has to fit as well.
        if np.isfinite(count) and one.bias_error <= target:
            choices.append(Choice(one, count, one.cost * count / one.num_samples))
    return min(choices, key=lambda one: one.seconds, default=None)
