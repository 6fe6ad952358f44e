"""From settings to numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.motion import ARMS, CONTINUOUS, DISCRETE, Read, at_time_step, motion
from experiments.sawtooth.cases import case
from experiments.sawtooth.settings import Settings
from experiments.workspace import Workspace
from mjxgrad._mjx import mjx
from mjxgrad.diagnostics import SlopeComparison, compare_to_slope, phases

# The trend that an outcome may have over the interval; what it leaves is the sawtooth.
_DEGREE = 9
_READING, _SAMPLE = ("arm", "time", "coordinate"), ("arm", "start", "time", "coordinate")
_NUM_TIMES = 5  # at which outcomes are read, evenly over the motion


@dataclass(frozen=True)
class Outcome:
    """Each motion at each time step, as `course` gives it."""

    courses: list[xr.Dataset]

    def rows(self) -> list[dict[str, Any]]:
        """Give one row per arm and reading, for metrics.csv."""
        frames = [one.drop_dims("start").to_dataframe().reset_index() for one in self.courses]
        return [row for frame in frames for row in frame.to_dict("records")]


def course(
    name: str,
    title: str,
    labels: Sequence[str],
    timestep: float,
    times: Float[np.ndarray, " times"],
    arms: Mapping[str, SlopeComparison],
    reference: Float[np.ndarray, "starts times coordinates"] | None = None,
) -> xr.Dataset:
    """Put together what was found of one motion at one time step, by `arm`, `start`, `time` and `coordinate`.

    Of each arm: `residual`, the outcome less its trend over the starts, and its standard deviation, the `sawtooth`; the
    `derivative` at each start and their `spread` about the trend, over the slope; `slope`, `mean` and `mean_error`; the
    `error` of the mean over the slope, what of it is in `excess` of two standard errors, and whether it is `within` these;
    the mean distance `far` from the reference, MuJoCo's motion at a much shorter step, NaN without one. Of all: where
    MuJoCo's outcome has teeth (`has_impact`), how many times `smaller` they are with an onset, the `shift` of the mean
    outcome by it, over MuJoCo's teeth, and `closer`, its distance from the reference over MuJoCo's.
    """
    found = [arms[arm] for arm in ARMS]
    start, shape = found[0].parameters, found[0].slope.shape
    names = ("slope", "mean", "mean_error", "standard_error", "resolution")
    data = xr.Dataset(
        {name: (_READING, np.stack([getattr(one, name).reshape(shape) for one in found])) for name in names},
        coords={"arm": list(ARMS), "start": start, "time": times, "coordinate": list(labels)},
    ).assign_coords(case=name, title=title, timestep=timestep)
    data["outcome"] = _SAMPLE, np.stack([one.outcomes for one in found])
    data["derivative"] = _SAMPLE, np.stack([one.derivatives[0] for one in found])
    data["residual"] = _SAMPLE, np.stack([_without_trend(start, one.outcomes) for one in found])
    data["sawtooth"] = data.residual.std("start")
    off, slope = abs(data["mean"] - data.slope), np.maximum(abs(data.slope), data.resolution)
    data["error"], data["excess"] = off / slope, np.maximum(off - 2 * data.standard_error, 0) / slope
    data["within"] = off <= 2 * np.maximum(data.standard_error, data.resolution)
    missing = np.full_like(found[0].outcomes, np.nan) if reference is None else reference
    data["far"] = abs(data.outcome - xr.DataArray(missing, dims=_SAMPLE[1:])).mean("start")
    spread = np.stack([_without_trend(start, one.derivatives[0]).std(axis=0) for one in found])
    theirs, own = (data.sel(arm=arm, drop=True) for arm in (DISCRETE, CONTINUOUS))
    tiny = np.finfo(float).tiny
    return data.assign(
        spread=xr.DataArray(spread, dims=_READING) / abs(own.slope),
        has_impact=theirs.sawtooth > 1e-6 * (abs(theirs.outcome).max("start") + tiny),
        smaller=theirs.sawtooth / np.maximum(own.sawtooth, tiny),
        shift=abs((own.outcome - theirs.outcome).mean("start")) / theirs.sawtooth,
        closer=own.far / theirs.far,
    )


def _without_trend(
    start: Float[np.ndarray, " starts"], values: Float[np.ndarray, "starts *rest"]
) -> Float[np.ndarray, "starts *rest"]:
    place = (2 * start - start[0] - start[-1]) / (start[-1] - start[0])
    basis = np.polynomial.legendre.legvander(place, _DEGREE)
    flat = values.reshape(len(place), -1)
    return (flat - basis @ np.linalg.lstsq(basis, flat, rcond=None)[0]).reshape(values.shape)


@eqx.filter_jit
def _sample(
    model: mjx.Model, start: mjx.Data, parameters: Array, steps_between: Array, read: Read, moved: int, arm: str
) -> tuple[Array, Array]:
    """Give readings and derivatives; time steps differ in arrays alone, so one compilation serves them all."""
    gradient, onset = ARMS[arm]
    how = {"num_times": _NUM_TIMES, "steps_between": steps_between, "gradient": gradient, "onset": onset}

    def simulate(parameter: Float[Array, ""]) -> Float[Array, "times labels"]:
        return motion(model, start.replace(qpos=start.qpos.at[moved].add(parameter)), read, **how)

    return jax.vmap(lambda x: jax.jvp(simulate, (x,), (jnp.ones_like(x),)))(parameters)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Sample outcomes and derivatives of every motion at every time step."""
    courses = []
    with workspace.stage("rollouts", "motions", len(settings.cases)) as advance_to:
        for number, name in enumerate(settings.cases):
            own = float(case(name).model.opt.timestep)
            courses += [_course(name, h, settings) for h in sorted({own, *settings.timesteps}, reverse=True)]
            advance_to(number + 1)
    return Outcome(courses)


def _course(name: str, timestep: float, settings: Settings) -> xr.Dataset:
    one = case(name)
    scene = mg.load_scene(one.model)
    qpos, qvel = np.array(scene.data.qpos), np.array(scene.data.qvel)
    qpos[list(one.qpos)], qvel[list(one.qvel)] = list(one.qpos.values()), list(one.qvel.values())
    start = scene.data.replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))
    # Neither evenly spaced nor of one length: teeth must not fall in step with the starts.
    parameters = phases(one.interval, settings.num_phases)
    steps = max(1, round(one.duration / timestep / _NUM_TIMES))

    def sampled(arm: str, refinement: int = 1) -> list[np.ndarray]:
        model, count = at_time_step(scene.model, timestep / refinement), jnp.int32(steps * refinement)
        both = _sample(model, start, jnp.asarray(parameters), count, one.read, one.moved, arm)
        return [np.asarray(each) for each in both]

    arms = {}
    for arm in ARMS:
        outcomes, derivatives = sampled(arm)
        arms[arm] = compare_to_slope(parameters, outcomes, [derivatives], (arm,))
    reference = sampled(DISCRETE, settings.reference)[0] if settings.reference else None
    times = timestep * steps * np.arange(1, _NUM_TIMES + 1)
    return course(name, one.title, one.labels, timestep, times, arms, reference)
