"""The numbers of an experiment on impacts, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from experiments.landing.settings import LandingSettings
from mjxgrad.diagnostics import JitterComparison, SlopeComparison

DISCRETE, EVENT = "discrete", "event"


@dataclass(frozen=True)
class Course:
    """One motion at one time step.

    Attributes:
        name: of the case.
        title: of the case.
        labels: of what was read.
        timestep: in s.
        refinement: by what the motion's own time step was divided.
        times: of the readings, in s.
        events: when contacts and limits begin, in the middle of the interval, in s.
        found: derivatives beside the slope, by time and label.
        tolerance: of the error.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    timestep: float
    refinement: int
    times: Float[np.ndarray, " times"]
    events: Float[np.ndarray, " events"]
    found: SlopeComparison | JitterComparison
    tolerance: float

    @property
    def can_judge(self) -> Bool[np.ndarray, "times labels"]:
        """Where the motion is regular and its slope known well enough to judge derivatives by."""
        return self.found.is_resolved(self.tolerance) & self.found.is_regular

    @property
    def has_impact(self) -> Bool[np.ndarray, "times labels"]:
        """Where an event has come before, in the middle of the interval; earlier both derivatives are exact."""
        first = self.events.min() if len(self.events) else np.inf
        return np.broadcast_to((self.times > first)[:, None], self.found.slope.shape)

    @property
    def is_heavy(self) -> Bool[np.ndarray, "times labels"]:
        """Where the mean of the event gradients hangs on a few of the jittered starts, and its error bar with it."""
        if not isinstance(self.found, JitterComparison):
            return np.zeros(self.found.slope.shape, bool)
        return self.found.is_heavy[self.found.gradients.index(EVENT)]

    def share(self, gradient: str) -> tuple[int, int, int]:
        """Count, after the first impact, where a derivative is within the tolerance, where beyond it, and what is judged.

        The last count is larger than the sum of the first two where more rollouts would be needed to tell.

        Args:
            gradient: its name.
        """
        row = self.found.gradients.index(gradient)
        judged = self.can_judge & self.has_impact
        close, off = self.found.is_close(self.tolerance)[row], self.found.is_off(self.tolerance)[row]
        return int((close & judged).sum()), int((off & judged).sum()), int(judged.sum())

    def worst(self, gradient: str) -> float:
        """Give the largest relative error after the first impact, where it can be judged; NaN where it nowhere can.

        Args:
            gradient: its name.
        """
        row = self.found.gradients.index(gradient)
        judged = self.can_judge & self.has_impact
        return float(self.found.relative_error[row][judged].max()) if judged.any() else np.nan

    def median(self, gradient: str) -> float:
        """Give the median relative error after the first impact, where it can be judged; NaN where it nowhere can.

        Args:
            gradient: its name.
        """
        row = self.found.gradients.index(gradient)
        judged = self.can_judge & self.has_impact
        return float(np.median(self.found.relative_error[row][judged])) if judged.any() else np.nan


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        courses: by case, and within it by refinement.
    """

    settings: LandingSettings
    courses: list[list[Course]]

    @property
    def all(self) -> list[Course]:
        """Every course."""
        return [course for group in self.courses for course in group]

    def rows(self) -> list[dict[str, Any]]:
        """One row per course, time and label, for metrics.csv."""
        rows = []
        for course in self.all:
            found = course.found
            for i, j in np.ndindex(found.slope.shape):
                rows.append(
                    {
                        "case": course.name,
                        "timestep": course.timestep,
                        "time": float(course.times[i]),
                        "outcome": course.labels[j],
                        "slope": float(found.slope[i, j]),
                        "slope_error": float(found.slope_error[i, j]),
                        "can_judge": bool(course.can_judge[i, j]),
                        "is_heavy": bool(course.is_heavy[i, j]),
                        **{
                            f"{name}{suffix}": float(values[row, i, j])
                            for row, name in enumerate(found.gradients)
                            for suffix, values in (
                                ("", found.mean),
                                ("_error", found.mean_error),
                                ("_spread", found.spread),
                                ("_relative_error", found.relative_error),
                                ("_relative_error_bar", found.standard_error / found.scale),
                            )
                        },
                    }
                )
        return rows
