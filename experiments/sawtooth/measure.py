"""From settings to numbers."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import mjxgrad as mg
from experiments.motion import ARMS, CONTINUOUS, DISCRETE, Read, at_time_step, motion
from experiments.sawtooth.cases import case
from experiments.sawtooth.settings import Settings
from experiments.workspace import Workspace
from mjxgrad._mjx import mjx
from mjxgrad.diagnostics import SlopeComparison
from mjxgrad.diagnostics.slope import compare_to_slope, phases

# The trend that an outcome may have over the interval; what it leaves is the sawtooth.
_DEGREE = 9


@dataclass(frozen=True)
class Course:
    """One motion at one time step.

    Attributes:
        name: of the case.
        title: of the case.
        labels: of what was read.
        timestep: in s.
        times: of the readings, in s.
        arms: what each arm's derivatives are beside the slope of its own outcome.
        reference: outcome of MuJoCo's motion at a much shorter step; None without it.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    timestep: float
    times: Float[np.ndarray, " times"]
    arms: dict[str, SlopeComparison]
    reference: Float[np.ndarray, "phases times labels"] | None

    def sawtooth(self, arm: str) -> Float[np.ndarray, "times labels"]:
        """Give the standard deviation of the outcome about its trend over the starts."""
        return self.residual(arm).std(axis=0)

    def residual(self, arm: str) -> Float[np.ndarray, "phases times labels"]:
        """Give the outcome less its trend over the starts."""
        return self._without_trend(self.arms[arm].outcomes)

    def _without_trend(self, values: Float[np.ndarray, "phases *rest"]) -> Float[np.ndarray, "phases *rest"]:
        start = self.arms[DISCRETE].parameters
        place = (2 * start - start[0] - start[-1]) / (start[-1] - start[0])
        basis = np.polynomial.legendre.legvander(place, _DEGREE)
        flat = values.reshape(len(place), -1)
        return (flat - basis @ np.linalg.lstsq(basis, flat, rcond=None)[0]).reshape(values.shape)

    @property
    def has_impact(self) -> Bool[np.ndarray, "times labels"]:
        """Where MuJoCo's outcome has teeth."""
        size = np.abs(self.arms[DISCRETE].outcomes).max(axis=0) + np.finfo(float).tiny
        return self.sawtooth(DISCRETE) > 1e-6 * size

    @property
    def shift(self) -> Float[np.ndarray, "times labels"]:
        """By how much the mean outcome differs from MuJoCo's."""
        return np.abs((self.arms[CONTINUOUS].outcomes - self.arms[DISCRETE].outcomes).mean(axis=0))

    def spread(self, arm: str) -> Float[np.ndarray, "times labels"]:
        """Give the standard deviation of single derivatives about their trend, over the slope."""
        rest = self._without_trend(self.arms[arm].derivatives[0])
        return rest.std(axis=0) / np.abs(self.arms[CONTINUOUS].slope)

    def error(self, arm: str) -> Float[np.ndarray, "times labels"] | None:
        """Give the mean distance to the converged motion."""
        return None if self.reference is None else np.abs(self.arms[arm].outcomes - self.reference).mean(axis=0)


@dataclass(frozen=True)
class Outcome:
    """All motions at all time steps."""

    courses: list[Course]

    def rows(self) -> list[dict[str, Any]]:
        """Give one row per reading, for metrics.csv."""
        return [row for course in self.courses for row in _rows(course)]


def _rows(course: Course) -> list[dict[str, Any]]:
    rows = []
    for i, j in np.ndindex(course.has_impact.shape):
        row: dict[str, Any] = {
            "case": course.name,
            "timestep": course.timestep,
            "time": float(course.times[i]),
            "outcome": course.labels[j],
            "has_impact": bool(course.has_impact[i, j]),
            "shift": float(course.shift[i, j]),
        }
        for arm, found in course.arms.items():
            error = course.error(arm)
            row |= {
                f"{arm} slope": float(found.slope[i, j]),
                f"{arm} mean": float(found.mean[0, i, j]),
                f"{arm} standard error": float(found.standard_error[0, i, j]),
                f"{arm} spread": float(course.spread(arm)[i, j]),
                f"{arm} sawtooth": float(course.sawtooth(arm)[i, j]),
                f"{arm} error": float("nan") if error is None else float(error[i, j]),
            }
        rows.append(row)
    return rows


class _Simulate(eqx.Module):
    """From the parameter to the readings; time steps differ in arrays alone, so one compilation serves them all."""

    model: mjx.Model
    start: mjx.Data
    steps_between: Int[Array, ""]
    onset: mg.Onset | None
    read: Read = eqx.field(static=True)
    moved: int = eqx.field(static=True)
    num_times: int = eqx.field(static=True)
    gradient: str = eqx.field(static=True)

    def __call__(self, parameter: Float[Array, ""]) -> Float[Array, "times labels"]:
        start = self.start.replace(qpos=self.start.qpos.at[self.moved].add(parameter))
        return motion(
            self.model,
            start,
            self.read,
            num_times=self.num_times,
            steps_between=self.steps_between,
            gradient=self.gradient,
            onset=self.onset,
        )


@eqx.filter_jit
def _sample(simulate: _Simulate, parameters: Float[Array, " phases"]) -> tuple[Array, Array]:
    def one(parameter: Float[Array, ""]) -> tuple[Array, Array]:
        return jax.jvp(simulate, (parameter,), (jnp.ones_like(parameter),))

    return jax.vmap(one)(parameters)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Sample outcomes and derivatives of every motion at every time step."""
    courses = []
    with workspace.stage("rollouts", "motions", len(settings.cases)) as advance_to:
        for number, name in enumerate(settings.cases):
            own = float(case(name).model.opt.timestep)
            courses += [_course(name, h, settings) for h in sorted({own, *settings.timesteps}, reverse=True)]
            advance_to(number + 1)
    return Outcome(courses)


def _course(name: str, timestep: float, settings: Settings) -> Course:
    one = case(name)
    scene = mg.load_scene(one.model)
    qpos, qvel = scene.data.qpos, scene.data.qvel
    for index, value in one.qpos.items():
        qpos = qpos.at[index].set(value)
    for index, value in one.qvel.items():
        qvel = qvel.at[index].set(value)
    start = scene.data.replace(qpos=qpos, qvel=qvel)
    # Neither evenly spaced nor of one length: teeth must not fall in step with the starts.
    parameters = phases(one.interval, settings.num_phases)
    steps = max(1, round(one.duration / timestep / settings.num_times))

    def sampled(gradient: str, onset: mg.Onset | None, refinement: int = 1) -> tuple[np.ndarray, np.ndarray]:
        simulate = _Simulate(
            at_time_step(scene.model, timestep / refinement),
            start,
            jnp.int32(steps * refinement),
            onset,
            one.read,
            one.moved,
            settings.num_times,
            gradient,
        )
        values, slopes = _sample(simulate, jnp.asarray(parameters))
        return np.asarray(values), np.asarray(slopes)

    arms = {}
    for arm, (gradient, onset) in ARMS.items():
        outcomes, derivatives = sampled(gradient, onset)
        arms[arm] = compare_to_slope(parameters, outcomes, [derivatives], (arm,))
    reference = sampled("discrete", None, settings.reference)[0] if settings.reference else None
    times = timestep * steps * np.arange(1, settings.num_times + 1)
    return Course(name, one.title, one.labels, timestep, times, arms, reference)
