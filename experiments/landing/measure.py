"""From settings to numbers."""

import copy
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

import mjxgrad as mg
from experiments.failure import ExperimentError
from experiments.landing.cases import Case, case, jittered_positions
from experiments.landing.outcome import DISCRETE, EVENT, Course, Outcome
from experiments.landing.settings import LandingSettings
from experiments.motion import Read, at_time_step, motion
from experiments.workspace import Workspace
from mjxgrad._mjx import mjx
from mjxgrad.diagnostics import JitterComparison, SlopeComparison, derivative_against_slope, derivative_under_jitter


class _Simulate(eqx.Module):
    """From the parameter to the readings; time steps differ in arrays alone, so one compilation serves them all."""

    model: mjx.Model
    start: mjx.Data
    steps_between: Int[Array, ""]
    read: Read = eqx.field(static=True)
    moved: int = eqx.field(static=True)
    num_times: int = eqx.field(static=True)

    def __call__(self, parameter: Float[Array, ""], gradient: str) -> Float[Array, "times labels"]:
        return self.jittered(parameter, (0.0, 0.0), gradient)

    def jittered(
        self, parameter: Float[Array, ""], jitter: tuple[ArrayLike, ArrayLike], gradient: str
    ) -> Float[Array, "times labels"]:
        """Read the motion from a start with noise on positions and velocities."""
        qpos = self.start.qpos.at[self.moved].add(parameter) + jitter[0]
        start = self.start.replace(qpos=qpos, qvel=self.start.qvel + jitter[1])
        return motion(
            self.model, start, self.read, num_times=self.num_times, steps_between=self.steps_between, gradient=gradient
        )


def measure(settings: LandingSettings, workspace: Workspace) -> Outcome:
    """Compare both derivatives with the slope, for every motion and time step.

    Args:
        settings: of the run.
        workspace: for the clock.

    Returns:
        The numbers.

    Raises:
        ExperimentError: if the readings do not fall on time steps.
    """
    cases = {name: case(name) for name in settings.cases}
    for name, one in cases.items():
        _check(name, one, settings)
        workspace.check(mg.load_scene(one.model))
    groups = []
    total = len(cases) * len(settings.refinements)
    with workspace.stage("rollouts", "motions", total) as advance_to:
        for name, one in cases.items():
            group = []
            for refinement in settings.refinements:
                group.append(_course(name, one, settings, refinement))
                advance_to(sum(map(len, groups)) + len(group))
            groups.append(group)
    return Outcome(settings, groups)


def _check(name: str, one: Case, settings: LandingSettings) -> None:
    steps = one.duration / one.model.opt.timestep / settings.num_times
    if abs(steps - round(steps)) > 1e-6 or steps < 1:
        raise ExperimentError(
            f"num_times must divide the {round(one.duration / one.model.opt.timestep)} steps of {name}, "
            f"got {settings.num_times}"
        )


def _course(name: str, one: Case, settings: LandingSettings, refinement: int) -> Course:
    scene = mg.load_scene(one.model)
    timestep = one.model.opt.timestep / refinement
    steps = round(one.duration / timestep / settings.num_times)
    start = scene.data.replace(qpos=_replaced(scene.data.qpos, one.qpos), qvel=_replaced(scene.data.qvel, one.qvel))
    simulate = _Simulate(
        at_time_step(scene.model, timestep), start, jnp.int32(steps), one.read, one.moved, settings.num_times
    )
    found = _compare(simulate, one, settings)
    times = timestep * steps * np.arange(1, settings.num_times + 1)
    events = _event_times(one, timestep)
    return Course(name, one.title, one.labels, timestep, refinement, times, events, found, settings.tolerance)


def _compare(simulate: _Simulate, one: Case, settings: LandingSettings) -> SlopeComparison | JitterComparison:
    gradients = (DISCRETE, EVENT)
    if settings.average_over == "phases":
        return derivative_against_slope(simulate, one.interval, num_phases=settings.num_phases, gradients=gradients)
    positions = settings.position_stddev * jnp.asarray(jittered_positions(one))
    num_velocities = one.model.nv

    def jitter(key: PRNGKeyArray) -> tuple[Array, Array]:
        position_key, velocity_key = jax.random.split(key)
        return (
            positions * jax.random.normal(position_key, positions.shape),
            settings.velocity_stddev * jax.random.normal(velocity_key, (num_velocities,)),
        )

    return derivative_under_jitter(
        simulate.jittered,
        one.interval,
        jax.random.key(settings.seed),
        jitter=jitter,
        num_samples=settings.num_samples,
        gradients=gradients,
    )


def _replaced(values: Array, changes: Mapping[int, float]) -> Array:
    for index, value in changes.items():
        values = values.at[index].set(value)
    return values


def _event_times(one: Case, timestep: float) -> Float[np.ndarray, " events"]:
    """Give when contacts and limits begin, by C MuJoCo from the middle of the interval."""
    model = copy.copy(one.model)
    model.opt.timestep = timestep
    data = mujoco.MjData(model)
    for index, value in one.qpos.items():
        data.qpos[index] = value
    for index, value in one.qvel.items():
        data.qvel[index] = value
    data.qpos[one.moved] += np.mean(one.interval)
    times, before = [], set()
    for _ in range(round(one.duration / timestep)):
        mujoco.mj_forward(model, data)
        is_pushing = data.contact.dist < data.contact.includemargin
        touching = {tuple(pair) for pair in data.contact.geom[is_pushing].tolist()}
        is_limit = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
        touching |= {("limit", int(joint)) for joint in data.efc_id[is_limit]}
        times += [data.time] if touching - before else []
        before = touching
        mujoco.mj_step(model, data)
    return np.array(times)
