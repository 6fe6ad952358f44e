"""The numbers of the experiment on the thrown cube."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.cube_toss.settings import Settings

METHODS = {
    "discrete": "discrete",
    "event": "event",
    "continuous": "contact that begins within the step",
    "substeps": "event, short steps at events",
    "adaptive": "adaptive, differentiated",
    "quotient": "adaptive, difference quotient",
}


@dataclass(frozen=True)
class Point:
    """One method at one setting.

    Attributes:
        method: a key of `METHODS`.
        setting: time step in s, or tolerance.
        derivative: of each throw, in m per m/s.
        error: derivative less reference.
        seconds: processor time of one derivative, compiled.
        first_seconds: wall time of the first call, which compiles unless an earlier setting did.
        num_steps: of one derivative.
        has_failed: whether the integration gave up.
    """

    method: str
    setting: float
    derivative: np.ndarray
    error: np.ndarray
    seconds: float
    first_seconds: float
    num_steps: float
    has_failed: bool


@dataclass(frozen=True)
class Course:
    """All methods with one contact.

    Attributes:
        contact: its name.
        speeds: of the throws, in m/s.
        reference: derivative of each throw.
        points: one per method and setting.
    """

    contact: str
    speeds: np.ndarray
    reference: np.ndarray
    points: tuple[Point, ...]

    @property
    def scale(self) -> float:
        """Give the size of the derivative."""
        return float(np.abs(self.reference).mean())

    def of(self, method: str) -> list[Point]:
        """Give the points of a method."""
        return [point for point in self.points if point.method == method]

    def error(self, point: Point) -> float:
        """Give the root-mean-square error over the throws, as a share of the derivative; infinite if it failed."""
        share = float(np.sqrt(np.mean(point.error**2))) / self.scale
        return share if np.isfinite(share) and not point.has_failed else np.inf

    def bias(self, point: Point) -> float:
        """Give the mean error over the throws, as a share of the derivative."""
        return float(np.mean(point.error)) / self.scale

    def fastest(self, target: float) -> Point | None:
        """Give the fastest point from which on its method stays below an error; None if there is none."""
        found = []
        for method in METHODS:
            # From accurate to coarse: one lucky coarse point between bad ones does not count.
            for point in sorted(self.of(method), key=lambda one: one.setting):
                if self.error(point) > target:
                    break
                found.append(point)
        return min(found, key=lambda one: one.seconds, default=None)


@dataclass(frozen=True)
class Outcome:
    """All numbers.

    Attributes:
        settings: of the run.
        courses: one per contact.
    """

    settings: Settings
    courses: tuple[Course, ...]

    def rows(self) -> list[dict[str, Any]]:
        """Give the rows of metrics.csv."""
        return [
            {
                "contact": course.contact,
                "method": point.method,
                "setting": point.setting,
                "derivative": float(point.derivative.mean()),
                "reference": float(course.reference.mean()),
                "relative_error": course.error(point),
                "relative_bias": course.bias(point),
                "processor_seconds": point.seconds,
                "first_call_seconds": point.first_seconds,
                "num_steps": point.num_steps,
                "has_failed": point.has_failed,
            }
            for course in self.courses
            for point in course.points
        ]
