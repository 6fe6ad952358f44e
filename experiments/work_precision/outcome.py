"""The numbers of an experiment on error against run time, and what follows from them."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.work_precision.front import pareto_front
from experiments.work_precision.settings import Settings

C = "C MuJoCo"
MG, MJX, ONSET = "mg.step", "mjx.step", "mg.step, onset"
# Of the solver, enough to converge.
NUM_ITERATIONS = 100


@dataclass(frozen=True)
class Point:
    """One way of simulating a scene.

    Attributes:
        library: `mg.step`, with an onset or without, `mjx.step` or C MuJoCo.
        integrator: its name.
        cone: of friction.
        precision: of the numbers.
        timestep: in s.
        tolerance: of the solver.
        iterations: of the solver, at most.
        batch: states simulated together.
        position_error: root mean square over the states of the distance in m and rad, over that of the way gone.
        velocity_error: likewise of velocities, over their size.
        seconds: wall time per simulated second of one state, of each repetition.
        compile_seconds: to trace and compile the program, which serves many points; 0 where nothing is compiled.
    """

    library: str
    integrator: str
    cone: str
    precision: str
    timestep: float
    tolerance: float
    iterations: int
    batch: int
    position_error: float
    velocity_error: float
    seconds: tuple[float, ...]
    compile_seconds: float = 0.0

    @property
    def error(self) -> float:
        """The larger of both errors; infinite if some state is not finite."""
        worst = max(self.position_error, self.velocity_error)
        return worst if np.isfinite(worst) else np.inf

    @property
    def cost(self) -> float:
        """Median wall time per simulated second of one state."""
        return float(np.median(self.seconds))

    @property
    def line(self) -> tuple[Any, ...]:
        """What it has in common with the points that differ in time step alone."""
        return (
            self.library, self.integrator, self.cone, self.precision, self.tolerance, self.iterations, self.batch
        )  # fmt: skip

    @property
    def knob(self) -> float:
        """What gets smaller along a line."""
        return self.timestep


@dataclass(frozen=True)
class Reference:
    """What motions are compared with.

    Attributes:
        engine: whose contacts: MJX's, simulated by `mg.step`, or C MuJoCo's.
        cone: of friction.
        integrator: by which it was made.
        timestep: the finest, in s.
        error: distance between the finest run and the one at twice its step, as the points' errors are measured.
        coarser_error: likewise between the runs at two and four times the step.
        distance: from the same engine's reference with the scene's own cone: what the cone makes of the motion.
        distance_to_c: of MJX's contacts from C MuJoCo's: after the same steps where both are the same motion, else of their
            references.
    """

    engine: str
    cone: str
    integrator: str
    timestep: float
    error: float
    coarser_error: float
    distance: float
    distance_to_c: float = 0.0

    @property
    def converges(self) -> bool:
        """Whether halving the step still brought it nearer, or there is nothing left but rounding."""
        return self.error < 0.75 * self.coarser_error or self.error < 1e-9


@dataclass(frozen=True)
class Estimate:
    """One way of estimating a gradient.

    Attributes:
        estimator: its name, with the derivative that it uses.
        num_samples: per estimate.
        timestep: in s.
        softening: factor on the contacts' time constant.
        error: root of squared bias and variance.
        spread: quartiles over repetitions of the distance to the reference, over its norm.
        bias: distance of the mean to the reference, what chance explains taken off; over the reference's norm.
        bias_error: what chance would make of a bias of zero.
        variance: of one estimate over repetitions, the trace; over the reference's squared norm.
        seconds: wall time of one estimate, by the rollouts that it takes, of each repetition.
        compile_seconds: to trace and compile the rollouts.
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
        """Median wall time of one estimate."""
        return float(np.median(self.seconds))

    @property
    def line(self) -> tuple[Any, ...]:
        """What it has in common with the estimates that differ in the number of samples alone."""
        return self.estimator, self.timestep, self.softening

    def samples_for(self, target: float) -> float:
        """Give how many samples bring the error to a target, were bias and variance per sample to stay; or infinity."""
        room = target**2 - self.bias**2
        return max(2.0, np.ceil(self.variance * self.num_samples / room)) if room > 0 else np.inf


@dataclass(frozen=True)
class GradientReference:
    """What gradients are compared with.

    Attributes:
        value: the gradient of the smoothed outcome at the finest step, by its correlation with the noise.
        standard_error: of its norm, relative.
        step_error: its change when the step is halved, relative.
        difference: the same gradient by differences of smoothed outcomes, on other samples; its distance, relative.
        difference_error: what chance explains of that distance, relative.
        timestep: the finest, in s.
    """

    value: tuple[float, ...]
    standard_error: float
    step_error: float
    difference: float
    difference_error: float
    timestep: float

    @property
    def error(self) -> float:
        """Give what the reference itself may be off by, relative."""
        return float(np.hypot(self.standard_error, self.step_error))

    @property
    def agrees(self) -> bool:
        """Whether both ways agree within three standard errors; the difference's own bias, a per cent, granted."""
        return self.difference < 3 * self.difference_error + 0.02


@dataclass(frozen=True)
class Course:
    """All that was measured on one scene.

    Attributes:
        name: of the scene.
        title: of the scene.
        timestep: the scene's own, in s.
        cone: the scene's own.
        points: of the motion.
        references: of the motion.
        estimates: of the gradient.
        gradient_reference: what they are compared with.
    """

    name: str
    title: str
    timestep: float
    cone: str
    points: tuple[Point, ...]
    references: tuple[Reference, ...]
    estimates: tuple[Estimate, ...]
    gradient_reference: GradientReference

    def reference(self, engine: str, cone: str) -> Reference:
        """Give the reference of an engine with a cone."""
        return next(one for one in self.references if (one.engine, one.cone) == (engine, cone))

    def floor(self, library: str, cone: str | None = None) -> float:
        """Give the error below which a library's errors are not known."""
        return self.reference(C if library == C else MG, cone or self.cone).error

    def in_batch(self, cone: str | None = None) -> list[Point]:
        """Give the points on the main axis: whole batches, with the scene's own cone or another."""
        largest = max(point.batch for point in self.points)
        return [point for point in self.points if point.batch == largest and point.cone == (cone or self.cone)]


@dataclass(frozen=True)
class Outcome:
    """All numbers.

    Attributes:
        settings: of the run.
        courses: one per scene.
    """

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
        names = list(dict.fromkeys(name for row in rows for name in row))
        return [{name: row.get(name, "") for name in names} for row in rows]


def relative_errors(
    positions: Float[np.ndarray, "batch nv"],
    velocities: Float[np.ndarray, "batch nv"],
    scales: tuple[float, float],
) -> tuple[float, float]:
    """Give root-mean-square distances over states, relative; NaN if one is not finite.

    Args:
        positions: differences.
        velocities: differences.
        scales: of positions and velocities.

    Returns:
        Both errors.
    """
    return tuple(rms(one) / scale for one, scale in zip((positions, velocities), scales, strict=True))  # pyright: ignore[reportReturnType]


def rms(differences: Float[np.ndarray, "batch nv"]) -> float:
    """Give the root mean square over states of the Euclidean norm."""
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))


def _flat(one: Point | Estimate) -> dict[str, Any]:
    values = asdict(one)
    seconds = values.pop("seconds")
    spread = values.pop("spread", None)
    if spread is not None:
        values |= {"error_quartile_low": spread[0], "error_quartile_high": spread[1]}
    unit = "seconds" if isinstance(one, Estimate) else "seconds_per_simulated_second"
    return {
        **values,
        "error": one.error,
        unit: one.cost,
        f"{unit}_min": min(seconds),
        f"{unit}_max": max(seconds),
        "num_repeats": len(seconds),
    }
