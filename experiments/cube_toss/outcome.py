"""The numbers of the experiment on the thrown cube."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

METHODS = {
    "discrete": "discrete",
    "event": "event",
    "continuous": "contact that begins within the step",
    "substeps": "event, short steps at events",
    "adaptive": "adaptive, differentiated",
    "quotient": "adaptive, difference quotient",
}
CONTACTS = {"published": "contact whose force begins continuously", "default": "MuJoCo's default contact"}


@dataclass(frozen=True)
class Point:
    """One method at one setting.

    Attributes:
        method: a key of `METHODS`.
        setting: time step in s, or tolerance.
        derivative: of each throw, in m per m/s.
        seconds: processor time of one derivative, compiled.
        first_seconds: wall time of the first call, which compiles unless an earlier setting did.
        num_steps: of one derivative.
        has_failed: whether the integration gave up.
    """

    method: str
    setting: float
    derivative: Float[np.ndarray, " throws"]
    seconds: float
    first_seconds: float
    num_steps: float
    has_failed: bool


@dataclass(frozen=True)
class Course:
    """All methods with one contact; errors are shares of the derivative.

    Attributes:
        contact: a key of `CONTACTS`.
        reference: derivative of each throw.
        points: one per method and setting.
    """

    contact: str
    reference: Float[np.ndarray, " throws"]
    points: tuple[Point, ...]

    @property
    def scale(self) -> float:
        """Give the size of the derivative."""
        return float(np.abs(self.reference).mean())

    def of(self, method: str) -> list[Point]:
        """Give the points of a method, from accurate to coarse."""
        return sorted((point for point in self.points if point.method == method), key=lambda point: point.setting)

    def errors(self, point: Point) -> Float[np.ndarray, " throws"]:
        """Give the error of every throw."""
        return (point.derivative - self.reference) / self.scale

    def error(self, point: Point) -> float:
        """Give the root-mean-square error over the throws; infinite if it failed."""
        share = float(np.sqrt(np.mean(self.errors(point) ** 2)))
        return share if np.isfinite(share) and not point.has_failed else np.inf


@dataclass(frozen=True)
class Outcome:
    """All numbers, one course per contact."""

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
                "relative_bias": float(course.errors(point).mean()),
                "processor_seconds": point.seconds,
                "first_call_seconds": point.first_seconds,
                "num_steps": point.num_steps,
                "has_failed": point.has_failed,
            }
            for course in self.courses
            for point in course.points
        ]
