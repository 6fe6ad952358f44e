"""The numbers of an experiment on error against run time."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from jaxtyping import Bool

from experiments.work_precision.settings import Settings

C, MG, MJX, ONSET = "C MuJoCo", "mg.step", "mjx.step", "mg.step, onset"
# Of the solver, enough to converge.
NUM_ITERATIONS = 100
# What single precision resolves, and the tolerance of the solver where it is not what is varied.
SINGLE_TOLERANCE, TIGHT_TOLERANCE = 1e-6, 1e-8

Integrator = Literal["Euler", "implicitfast", "RK4"]
Cone = Literal["pyramidal", "elliptic"]
Precision = Literal["float32", "float64"]


@dataclass(frozen=True)
class Variant:
    """What a program is compiled for, beside the scene, or how C MuJoCo is run.

    The library is `MG`, `MJX` or `C`; the derivative, along the uncertain velocities, is None for the motion alone.
    """

    library: str
    integrator: Integrator = "Euler"
    cone: Cone = "pyramidal"
    precision: Precision = "float64"
    batch: int = 1
    derivative: Literal["discrete", "slope"] | None = None
    onset: bool = False
    iterations: int = NUM_ITERATIONS


@dataclass(frozen=True)
class Knobs:
    """What a program is told at each call: time step (s), the solver's tolerance, a factor on contacts' time constants."""

    timestep: float
    tolerance: float
    softening: float = 1.0


@dataclass(frozen=True)
class Point:
    """One way of simulating a scene.

    Errors are root mean squares over the states: of the distance in m and rad, over that of the way gone, and of velocities, over
    their size. Seconds are the wall time per simulated second of one state, of each repetition; `compile_seconds`, to trace and
    compile the program, which serves many points, is 0 where nothing is compiled.
    """

    variant: Variant
    knobs: Knobs
    position_error: float
    velocity_error: float
    seconds: tuple[float, ...]
    compile_seconds: float = 0.0

    @property
    def library(self) -> str:
        """`mg.step`, with an onset or without, `mjx.step` or C MuJoCo."""
        return ONSET if self.variant.onset else self.variant.library

    @property
    def error(self) -> float:
        """The larger of both errors; infinite if some state is not finite."""
        worst = max(self.position_error, self.velocity_error)
        return worst if np.isfinite(worst) else np.inf

    @property
    def cost(self) -> float:
        return float(np.median(self.seconds))

    @property
    def line(self) -> tuple[Any, ...]:
        return self.variant, self.knobs.tolerance


@dataclass(frozen=True)
class Reference:
    """What motions are compared with, of C MuJoCo's contacts or of MJX's; its errors are measured as the points'."""

    error: float  # between the finest run and the one at twice its step
    coarser_error: float  # likewise between the runs at two and four times the step
    distance: float  # from the same engine's reference with the scene's own cone
    distance_to_c: float = 0.0  # after the same steps where both engines' motion is the same, else of their references

    @property
    def converges(self) -> bool:
        """Whether halving the step still brought it nearer, or there is nothing left but rounding."""
        return self.error < 0.75 * self.coarser_error or self.error < 1e-9


@dataclass(frozen=True)
class Estimate:
    """One way of estimating a gradient: its name, with the derivative that it uses, samples, time step (s) and softening.

    The error is the root of squared bias and variance, over the reference's norm as they are; `spread` are quartiles over
    repetitions of the distance to the reference. What chance explains is taken off the bias; `bias_error` is what it would make
    of none. The variance is that of one estimate, the trace; seconds are the wall time of its rollouts, of each repetition.
    """

    estimator: str
    num_samples: int
    timestep: float
    softening: float
    error: float
    spread: tuple[float, float]
    bias: float
    bias_error: float
    variance: float
    seconds: tuple[float, ...]
    compile_seconds: float

    @property
    def cost(self) -> float:
        return float(np.median(self.seconds))

    @property
    def line(self) -> tuple[Any, ...]:
        return self.estimator, self.timestep, self.softening


@dataclass(frozen=True)
class GradientReference:
    """What gradients are compared with: that of the smoothed outcome at the finest step, by its correlation with the noise.

    The rest is over its norm: its standard error, its change when the step is halved, the distance to the same gradient by
    differences of smoothed outcomes on other samples, and what chance explains of that distance.
    """

    value: tuple[float, ...]
    standard_error: float
    step_error: float
    difference: float
    difference_error: float

    @property
    def agrees(self) -> bool:
        """Whether both ways agree within three standard errors; the difference's own bias, a per cent, granted."""
        return self.difference < 3 * self.difference_error + 0.02


@dataclass(frozen=True)
class Course:
    """All that was measured on one scene: ways to simulate it, and to estimate the gradient.

    Time step (s) and cone are the scene's own. References of the motion are by engine, that of `MG`, which is MJX's too, or `C`,
    and by cone.
    """

    name: str
    title: str
    timestep: float
    cone: Cone
    points: Sequence[Point]
    references: dict[tuple[str, Cone], Reference]
    estimates: Sequence[Estimate]
    gradient_reference: GradientReference

    def floor(self, library: str) -> float:
        """Give the error below which a library's errors are not known."""
        return self.references[C if library == C else MG, self.cone].error

    def in_batch(self) -> list[Point]:
        """Give the points on the main axis: whole batches, with the scene's own cone."""
        largest = max(point.variant.batch for point in self.points)
        return [one for one in self.points if one.variant.batch == largest and one.variant.cone == self.cone]


@dataclass(frozen=True)
class Outcome:
    """All numbers: one course per scene."""

    settings: Settings
    courses: tuple[Course, ...]

    def rows(self) -> list[dict[str, Any]]:
        """Give the rows of metrics.csv: points of the motion first, then estimates of the gradient."""
        rows = []
        for course in self.courses:
            for kind, measured in (("motion", course.points), ("gradient", course.estimates)):
                on_front = pareto_front([one.cost for one in measured], [one.error for one in measured])
                for one, is_best in zip(measured, on_front, strict=True):
                    rows.append({"scene": course.name, "of": kind, **_flat(one), "on_front": bool(is_best)})
        return rows


def pareto_front(costs: npt.ArrayLike, errors: npt.ArrayLike) -> Bool[np.ndarray, " points"]:
    """Say which points no other beats in cost and error at once; of equal ones all, of those that are not finite none."""
    cost, error = np.asarray(costs, float), np.asarray(errors, float)
    no_worse = (cost <= cost[:, None]) & (error <= error[:, None])
    better = (cost < cost[:, None]) | (error < error[:, None])
    return ~(no_worse & better).any(axis=1) & np.isfinite(error) & np.isfinite(cost)


def _flat(one: Point | Estimate) -> dict[str, Any]:
    values = asdict(one)
    seconds = values.pop("seconds")
    if isinstance(one, Point):
        values = {**values.pop("variant"), **values.pop("knobs"), **values, "library": one.library}
        unit = "seconds_per_simulated_second"
    else:
        values["error_quartile_low"], values["error_quartile_high"] = values.pop("spread")
        unit = "seconds"
    times = {unit: one.cost, f"{unit}_min": min(seconds), f"{unit}_max": max(seconds), "num_repeats": len(seconds)}
    return {**values, "error": one.error, **times}
