"""The sawtooth: outcomes of impacts and their derivatives over where within a time step the impact falls."""

import copy
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import xarray as xr
from jaxtyping import Array, ArrayLike, Float, Int
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from pydantic import Field

import mjxgrad as mg
from experiments.motion import ARMS, CONTINUOUS, DISCRETE, SLOPE, Read, own_task
from experiments.problems import ASSETS
from experiments.report import Table, tabulated
from experiments.settings import OwnScene, Positive, RunSettings
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, subplots
from experiments.words import joined, percent
from experiments.workspace import Workspace
from mjxgrad.checking.sweep import Knob
from mjxgrad.diagnostics import SlopeComparison, compare_to_slope, phases
from mjxgrad.stepping import Gradient, own_motion
from mjxgrad.tasks import scene_path

RobotName = Literal["hopper", "walker2d", "half_cheetah", "ant"]
BallName = Literal["ball_frictionless", "ball", "ball_elliptic", "ball_torsion", "ball_rolling"]
OtherName = Literal["ball_inclined", "ball_inclined_rolling", "two_balls", "two_balls_elliptic", "arm"]


class Settings(OwnScene, RunSettings):
    """Outcomes of motions with impacts, and their derivatives, over where within a time step the impact falls."""

    # Which motions, each with its own contact, limits and integrator; a scene of one's own takes their place.
    cases: Annotated[tuple[Literal[RobotName, BallName, OtherName], ...], Field(min_length=1)]
    # How far to both sides the one number goes that moves an own scene: a constant control in halves of its range, or
    # without actuators a velocity at the start (m/s, rad/s).
    width: Positive = 0.05
    timesteps: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.002,)  # in s, besides the motion's own
    num_phases: Annotated[int, Field(ge=64)] = 192  # starts over the interval
    # By what the time step is divided for MuJoCo's converged motion; 0 leaves that comparison out.
    reference: Annotated[int, Field(ge=0, le=64)] = 0


@dataclass(frozen=True)
class Case:
    """A motion with impacts."""

    title: str
    model: mujoco.MjModel  # with its own contact, limits, integrator and time step
    moved: int  # index in `qpos` of the coordinate to which the parameter is added
    interval: tuple[float, float]  # of the parameter (m or rad); it moves the first impact through several time steps
    labels: tuple[str, ...]  # of what is read, with units
    read: Read
    duration: float  # in s
    qpos: Mapping[int, float] = field(default_factory=dict)  # start positions that differ from the model's, by index
    qvel: Mapping[int, float] = field(default_factory=dict)  # start velocities that differ from zero, by index

    @property
    def start(self) -> tuple[Float[np.ndarray, " nq"], Float[np.ndarray, " nv"]]:
        """Positions and velocities."""
        return filled(self.model.qpos0, self.qpos), filled(np.zeros(self.model.nv), self.qvel)


def filled(base: Float[np.ndarray, " n"], values: Mapping[int, float]) -> Float[np.ndarray, " n"]:
    """Return numbers with others in their place, by index."""
    base = base.copy()
    base[list(values)] = list(values.values())
    return base


def case(name: str) -> Case:
    """Build a motion by one of the names in `experiments.sawtooth.CaseName`."""
    return _BUILDERS[name]()


def _robot(title: str, file: str, qpos: dict[int, float], speed: float = 0.5, **other: Any) -> Case:
    """One of gymnasium's robots, dropped while it moves forwards."""
    planar = {"moved": 1, "labels": ("x", "z", "pitch (rad)"), "read": lambda qpos, _: qpos[:3]}
    model = mujoco.MjModel.from_xml_path(str(ASSETS / file))
    return Case(title, model, interval=(0.0, 0.03), duration=0.5, qpos=qpos, qvel={0: speed}, **planar | other)


_BALL = """<mujoco model="ball">
  <option timestep="0.002" cone="{cone}"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" euler="0 {slope} 0" condim="{condim}" friction="{friction}"/>
    <body name="ball" pos="0 0 {height}">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.05" condim="{condim}" friction="{friction}"/>
    </body>
  </worldbody>
</mujoco>"""


def ball(
    cone: str = "pyramidal", condim: int = 3, slope: float = 0.0, friction: float = 1.0, height: float = 0.1
) -> mujoco.MjModel:
    """Build a ball of 5 cm at a height (m) over a plane that is inclined by some degrees."""
    xml = _BALL.format(cone=cone, condim=condim, slope=slope, friction=friction, height=height)
    return mujoco.MjModel.from_xml_string(xml)


def _ball_case(cone: str, condim: int, slope: float = 0.0) -> Case:
    """A ball thrown down with spin; gravity brings it back for smaller bounces."""
    place = f"plane inclined by {slope:g}°" if slope else "level plane"
    return Case(
        f"Ball, {place}, {cone}, condim {condim}",
        ball(cone, condim, slope),
        moved=2,
        interval=(0.0, 0.03),
        labels=("x", "height", "spin (1/s per m)"),
        read=lambda qpos, qvel: jnp.array([qpos[0], qpos[2], qvel[4]]),
        duration=0.24,
        qvel={0: 1.0, 2: -1.5, 3: 2.0, 4: -10.0, 5: 5.0},
    )


def _two_balls_case(cone: str) -> Case:
    """An oblique hit, with its impact parameter moved."""
    model = mujoco.MjModel.from_xml_path(str(scene_path("two_balls")))
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    return Case(
        f"Two balls, oblique, {cone}",
        model,
        moved=1,
        interval=(0.03, 0.06),
        labels=("first, along", "first, across", "second, along", "second, across"),
        read=lambda qpos, _: qpos[jnp.array([0, 1, 7, 8])],
        duration=0.24,
        qvel={0: 1.5, 5: 3.0},
    )


_BUILDERS = {
    "hopper": lambda: _robot("Hopper", "hopper.xml", {1: 1.22, 3: -0.4, 4: -0.5, 5: 0.3}),
    "walker2d": lambda: _robot(
        "Walker2d", "walker2d.xml", {1: 1.24, 3: -0.3, 4: -0.4, 5: 0.3, 6: -0.1, 7: -0.7, 8: 0.2}
    ),
    "half_cheetah": lambda: _robot("Half cheetah", "half_cheetah.xml", {1: 0.05, 2: 0.1, 3: 0.3, 4: -0.3, 6: 0.2}),
    # Legs half bent and the trunk tilted, so that the feet land one after the other.
    "ant": lambda: _robot(
        "Ant",
        "ant.xml",
        {2: 0.72, 3: 0.9962, 4: 0.05, 5: 0.07, 7: 0.2, 8: 0.9, 10: -0.9, 12: -0.8, 14: 0.8},
        speed=0.3,
        moved=2,
        labels=("x", "z", "pitch (sine)"),
        read=lambda qpos, _: jnp.array([qpos[0], qpos[2], 2 * (qpos[3] * qpos[5] - qpos[6] * qpos[4])]),
    ),
    "ball_frictionless": lambda: _ball_case("pyramidal", 1),
    "ball": lambda: _ball_case("pyramidal", 3),
    "ball_elliptic": lambda: _ball_case("elliptic", 3),
    "ball_torsion": lambda: _ball_case("elliptic", 4),
    "ball_rolling": lambda: _ball_case("pyramidal", 6),
    "ball_inclined": lambda: _ball_case("pyramidal", 3, 20.0),
    "ball_inclined_rolling": lambda: _ball_case("elliptic", 6, 20.0),
    "two_balls": lambda: _two_balls_case("pyramidal"),
    "two_balls_elliptic": lambda: _two_balls_case("elliptic"),
    "arm": lambda: Case(
        "Two-link arm",
        mujoco.MjModel.from_xml_path(str(scene_path("falling_arm"))),
        moved=0,
        interval=(0.0, 0.06),
        labels=("shoulder (rad)", "elbow (rad)"),
        read=lambda qpos, _: qpos[:2],
        duration=0.4,
        qpos={0: 0.3, 1: 0.4},
    ),
}


# The trend that an outcome may have over the interval; what it leaves is the sawtooth.
_DEGREE = 9
# MuJoCo's motion and its two derivatives, by C MuJoCo and by MJX, and a motion whose contacts begin within the step.
NATIVE = "slope, C MuJoCo"
POLICY = "slope, C MuJoCo, of a policy"
_BY_MUJOCO: dict[str, Gradient] = {DISCRETE: "discrete", NATIVE: "slope", POLICY: "slope"}
_ARMS = (DISCRETE, NATIVE, POLICY, SLOPE, CONTINUOUS)
_TOGETHER = 64  # starts whose derivatives are held at once
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
    `error` of the mean over the slope, what of it is in `excess` of two standard errors, and if it is `right` to these or 5 %;
    the mean distance `far` from the reference, MuJoCo's motion at a much shorter step, NaN without one. Of all: where
    MuJoCo's outcome has teeth (`has_impact`), how many times `smaller` they are with an onset, the `shift` of the mean
    outcome by it, over MuJoCo's teeth, and `closer`, its distance from the reference over MuJoCo's.
    """
    found = [arms[arm] for arm in _ARMS]
    start, shape = found[0].parameters, found[0].slope.shape
    names = ("slope", "mean", "mean_error", "standard_error", "resolution")
    data = xr.Dataset(
        {name: (_READING, np.stack([getattr(one, name).reshape(shape) for one in found])) for name in names},
        coords={"arm": list(_ARMS), "start": start, "time": times, "coordinate": list(labels)},
    ).assign_coords(case=name, title=title, timestep=timestep)
    data["outcome"] = _SAMPLE, np.stack([one.outcomes for one in found])
    data["derivative"] = _SAMPLE, np.stack([one.derivatives[0] for one in found])
    data["residual"] = _SAMPLE, np.stack([_without_trend(start, one.outcomes) for one in found])
    data["sawtooth"] = data.residual.std("start")
    off, slope = abs(data["mean"] - data.slope), np.maximum(abs(data.slope), data.resolution)
    data["error"], data["excess"] = off / slope, np.maximum(off - 2 * data.standard_error, 0) / slope
    data["right"] = off <= np.maximum(2 * np.maximum(data.standard_error, data.resolution), 0.05 * slope)
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


def _sample(
    scene: mg.Scene,
    one: Case,
    parameters: Float[Array, " starts"],
    rows: Int[ArrayLike, " times"],
    has_derivative: bool = True,
    **how: Any,
) -> tuple[Float[Array, "starts times labels"], Float[Array, "starts times labels"]]:
    """Give readings of rollouts, in some rows of their states, and their derivatives by the parameter, or zeros."""
    qpos, qvel = map(jnp.asarray, one.start)

    def simulate(parameter: Float[Array, ""]) -> Float[Array, "times labels"]:
        course = mg.rollout(scene, mg.initial_state(scene, qpos.at[one.moved].add(parameter), qvel), **how)
        return jax.vmap(one.read)(course.qpos[rows], course.qvel[rows])

    def both(parameter: Float[Array, ""]) -> tuple[Array, Array]:
        if not has_derivative:
            return (outcome := simulate(parameter)), jnp.zeros_like(outcome)
        return jax.jvp(simulate, (parameter,), (jnp.ones_like(parameter),))

    return jax.lax.map(both, parameters, batch_size=_TOGETHER)


@functools.lru_cache(maxsize=1)
def _by_mjx(name: str, horizon: int) -> Callable[..., tuple[Array, Array]]:
    """Return samples by MJX, compiled once for all time steps."""
    one = case(name)
    scene, controls = mg.load_scene(one.model), jnp.zeros((horizon, one.model.nu))

    def sample(arm: str, timestep: Array, rows: Array, parameters: Array) -> tuple[Array, Array]:
        own = scene.with_model(timestep=timestep)
        return _sample(own, one, parameters, rows, controls=controls, contact=ARMS[arm])

    return jax.jit(sample, static_argnums=0)


def _by_mujoco(
    model: mujoco.MjModel, parameters: Array, rows: np.ndarray, one: Case, arm: str | None
) -> tuple[Array, Array]:
    """Give samples by C MuJoCo, under controls or a policy that are zero; without an arm readings alone."""
    scene, steps = mg.load_scene(model, engine="mujoco"), int(rows[-1])
    controls = jnp.zeros((steps, model.nu))
    acts, horizon = ((lambda _, state: controls[0]), steps) if arm == POLICY else (controls, None)
    how = {"controls": acts, "horizon": horizon, "contact": own_motion(_BY_MUJOCO[arm] if arm else "discrete")}
    return jax.jit(lambda at: _sample(scene, one, at, rows, arm is not None, **how))(parameters)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Sample outcomes and derivatives of every motion at every time step."""
    if settings.scene is not None:
        with workspace.stage("rollouts", "motions", 1):
            return Outcome([_own_course(settings, workspace)])

    def courses(name: str) -> list[xr.Dataset]:
        timesteps = sorted({float(case(name).model.opt.timestep), *settings.timesteps}, reverse=True)
        found = [_course(name, timestep, settings) for timestep in timesteps]
        jax.clear_caches()  # no other motion takes its programs, and a process may have 65 530 pieces of memory
        return found

    parts = {name: functools.partial(courses, name) for name in settings.cases}
    return Outcome(list(itertools.chain(*workspace.each("rollouts", "motions", parts))))


def _steps_between(one: Case, timestep: float) -> int:
    return max(1, round(one.duration / timestep / _NUM_TIMES))


def _course(name: str, timestep: float, settings: Settings) -> xr.Dataset:
    one = case(name)
    # Neither evenly spaced nor of one length: teeth must not fall in step with the starts.
    parameters = phases(one.interval, settings.num_phases)
    steps = _steps_between(one, timestep)
    horizon = _NUM_TIMES * _steps_between(one, min(one.model.opt.timestep, *settings.timesteps))

    model = copy.copy(one.model)
    model.opt.timestep = timestep
    arms = {}
    rows, starts = steps * np.arange(1, _NUM_TIMES + 1), jnp.asarray(parameters)
    for arm in _ARMS:
        if arm in _BY_MUJOCO:
            found = _by_mujoco(model, starts, rows, one, arm)
        else:
            found = _by_mjx(name, horizon)(arm, timestep, jnp.asarray(rows), starts)
        outcomes, derivatives = map(np.asarray, found)
        arms[arm] = compare_to_slope(parameters, outcomes, [derivatives], (arm,))
    reference = None
    if settings.reference:
        model.opt.timestep /= settings.reference
        reference = np.asarray(_by_mujoco(model, starts, settings.reference * rows, one, None)[0])
    return course(name, one.title, one.labels, timestep, timestep * rows, arms, reference)


def _own_course(settings: Settings, workspace: Workspace) -> xr.Dataset:
    """The cost of a scene of one's own at its own time step, over how far it is pushed."""
    task = own_task(settings, seed=settings.seed)
    workspace.check(task.scene)
    parameters, arms = phases((-settings.width, settings.width), settings.num_phases), {}
    for arm in _ARMS:
        is_c = arm in _BY_MUJOCO
        contact = own_motion(_BY_MUJOCO[arm]) if is_c else ARMS[arm]
        knob = Knob((task.with_engine("mujoco") if is_c else task).with_contact(contact), 1.0, settings.seed)
        objective = knob(mg.Softness(stiffness=knob.own or 1.0)).sized_for(jnp.zeros(1))

        def cost(at: Array, objective: mg.Objective = objective) -> Array:
            return objective.value(at[None], objective.zero_noise())

        both = jax.jit(jax.vmap(lambda x, cost=cost: jax.jvp(cost, (x,), (jnp.ones_like(x),))))(jnp.asarray(parameters))
        outcomes, derivatives = (np.asarray(each)[:, None, None] for each in both)
        arms[arm] = compare_to_slope(parameters, outcomes, [derivatives], (arm,))
    timestep = float(task.scene.mj_model.opt.timestep)
    times, name = timestep * np.array([task.horizon]), Path(str(settings.scene)).stem
    return course(name, name, (settings.cost or "a random mix",), timestep, times, arms)


def answer(outcome: Outcome) -> str:
    """Say how much smaller the teeth are, and how often the mean derivative is then the slope."""
    smaller = _pooled(outcome, "smaller")
    if not smaller.size:
        return "Nothing touches in these motions: there are no teeth."
    right = percent(_pooled(outcome, "right", CONTINUOUS).mean())
    return (
        f"With an onset the sawtooth is {np.median(smaller):.0f} times smaller, its mean derivative right at {right}."
    )


def verdict(outcome: Outcome) -> str:
    """Say whether teeth are gone, and whose mean derivative is the slope."""
    smaller, spread = _pooled(outcome, "smaller"), _pooled(outcome, "spread", CONTINUOUS)
    if not smaller.size:
        return "Nothing touches in these motions: there are no teeth."
    right = {arm: _pooled(outcome, "right", arm).mean() for arm in _ARMS}
    return (
        f"The sawtooth is {np.median(smaller):.0f} times smaller in the median ({np.quantile(smaller, 0.1):.0f} at the tenth "
        f"percentile) when contacts begin within the step. The mean of the plain derivative is then the slope within two "
        f"standard errors or 5% at {right[CONTINUOUS]:.0%} of {smaller.size} readings. In MuJoCo's own motion the slope is right "
        f"at {right[NATIVE]:.0%} by C MuJoCo and {right[SLOPE]:.0%} by MJX, MuJoCo's own derivative at {right[DISCRETE]:.0%}. "
        f"Single derivatives scatter by {np.median(spread):.2f} of the slope with an onset, "
        f"{np.median(_pooled(outcome, 'spread', NATIVE)):.2f} by C MuJoCo."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what the table's medians do not show: where a mean derivative is off, and how often the motion is worse."""
    sentences = []
    off = [c for c in outcome.courses if (c.excess.sel(arm=CONTINUOUS).where(c.has_impact) > 0.05).any()]
    if off:
        sentences.append(f"Some mean derivative is more than 5% beyond its error in {joined(map(_name, off))}.")
    closer = _pooled(outcome, "closer")
    if closer.size and np.isfinite(closer).all():
        sentences.append(
            f"Beside MuJoCo's motion at a step many times shorter its error is {np.median(closer):.2f} of MuJoCo's own in the "
            f"median, and larger at {np.mean(closer > 1):.0%} of the readings."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all motions."""
    rows = []
    for c in (one for one in outcome.courses if one.has_impact.any()):
        picked = c.where(c.has_impact)
        middle = picked.median(("time", "coordinate"))
        right, count = (c.right & c.has_impact).sum(("time", "coordinate")), int(c.has_impact.sum())
        row = {"motion": str(c.title.values), "time step, ms": f"{1e3 * float(c.timestep):g}"}
        row["sawtooth smaller, times"] = f"{float(middle.smaller):.0f} ({float(picked.smaller.min()):.1f})"
        row |= {f"spread, {arm}": f"{float(middle.spread.sel(arm=arm)):.2g}" for arm in _ARMS}
        row |= {f"error, {arm}": f"{float(middle.error.sel(arm=arm)):.1%}" for arm in _ARMS}
        row |= {f"right, {arm}": f"{int(right.sel(arm=arm))} of {count}" for arm in _ARMS}
        row["shift of the mean"] = f"{float(middle['shift']):.2f}"
        row["off the converged motion"] = "–" if np.isnan(middle.closer) else f"{float(middle.closer):.2f}"
        rows.append(row)
    caption = (
        "Medians over times and coordinates with an impact before them; in brackets the least. Spread: standard deviation of "
        "single derivatives about their trend, over the slope. Error: of the mean derivative, over the slope of its own outcome, "
        "sampling errors included; right: readings where it is within two of these or 5%. Shift of the mean outcome over "
        "MuJoCo's sawtooth. Distance of the outcome from the converged motion over MuJoCo's own."
    )
    return [tabulated(rows, caption)]


def _pooled(outcome: Outcome, name: str, arm: str | None = None) -> np.ndarray:
    """Give a number at every reading with an impact before it, of all motions."""
    picked = [(c[name] if arm is None else c[name].sel(arm=arm), c.has_impact) for c in outcome.courses]
    return np.concatenate([values.values[has_impact.values] for values, has_impact in picked])


def _name(course: xr.Dataset) -> str:
    return f"{course.title.values}, {1e3 * float(course.timestep):g} ms"


_COLOURS = {DISCRETE: FIRST, NATIVE: "#7a3fb0", SLOPE: ZEROTH, CONTINUOUS: ONSET}
_NAMES = {
    DISCRETE: "MuJoCo's step; its derivative",
    NATIVE: "slope, C MuJoCo",
    SLOPE: "slope, MJX",
    CONTINUOUS: "contact begins within the step",
}


def drawings(outcome: Outcome) -> Drawings:
    """Draw a figure per motion, at its longest time step."""
    longest: dict[str, xr.Dataset] = {}
    for course in outcome.courses:
        longest.setdefault(str(course.case.values), course)
    named = enumerate(longest.items())
    return {f"teeth_{name}": _teeth(course, is_first=k == 0) for k, (name, course) in named}


def _teeth(course: xr.Dataset, *, is_first: bool):
    """Draw the outcome less its trend and single derivatives over the start, and their mean over time."""
    figure, axes = subplots(3, course.coordinate.size, height=7.4)
    for column, label in zip(axes.T, course.coordinate.values, strict=True):
        one = course.sel(coordinate=label)
        _draw_starts(column[0], column[1], one.isel(time=-1))
        _draw_times(column[2], one)
        column[0].set_title(label)
    for row, label in enumerate(("outcome less its trend", "derivative, each start", "derivative, mean")):
        axes[row, 0].set_ylabel(label)
    handles = [Line2D([], [], color=_COLOURS[arm], marker=".", label=_NAMES[arm]) for arm in _COLOURS]
    handles.append(Line2D([], [], color=REFERENCE, label="slope of the simulated outcome"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
    title, duration, h = str(course.title.values), float(course.time[-1]), 1e3 * float(course.timestep)
    figure.suptitle(f"{title}, {duration:.2f} s, time step {h:g} ms", fontsize=10)
    caption = (
        "Above, where the motion ends up, less a smooth trend, against where it starts. In the middle, the derivative of each "
        "single rollout; the line is the slope of the outcome. Below, their mean against time. Derivatives far off are cut."
    )
    return figure, title, caption if is_first else "As the figure before."


def _draw_starts(upper: Axes, lower: Axes, one: xr.Dataset) -> None:
    """Draw one coordinate of the last reading over the start."""
    for arm in (DISCRETE, CONTINUOUS):
        upper.plot(one.start, one.residual.sel(arm=arm), color=_COLOURS[arm], lw=1.3)
    for arm in _COLOURS:
        lower.plot(one.start, one.derivative.sel(arm=arm), ".", color=_COLOURS[arm], ms=4)
    slope = float(one.slope.sel(arm=CONTINUOUS))
    lower.axhline(slope, color=REFERENCE, lw=1.2)
    _show(lower, np.append(np.quantile(one.derivative, [0.02, 0.98]), slope))
    upper.axhline(0, color=MUTED, lw=0.6)
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("start, m or rad")


def _draw_times(axis: Axes, one: xr.Dataset) -> None:
    """Draw the slope of one coordinate and the mean of each derivative over time."""
    slope = one.slope.sel(arm=CONTINUOUS)
    axis.plot(one.time, slope, color=REFERENCE, lw=2.6)
    for arm in _COLOURS:
        mean, wide = one["mean"].sel(arm=arm), 2 * one.mean_error.sel(arm=arm)
        axis.plot(one.time, mean, color=_COLOURS[arm], lw=1.3)
        axis.fill_between(one.time, mean - wide, mean + wide, color=_COLOURS[arm], alpha=0.15, lw=0)
    near = np.concatenate([slope, one["mean"].sel(arm=CONTINUOUS), [0.0]])
    reach = max(float(np.ptp(near)), 1e-9)
    _show(axis, np.append(near, np.clip(one["mean"], near.min() - reach, near.max() + reach)))
    axis.set_xlabel("time, s")


def _show(axis: Axes, values: np.ndarray) -> None:
    pad = 0.15 * max(float(np.ptp(values)), np.abs(values).max(), 1e-9)
    axis.set_ylim(values.min() - pad, values.max() + pad)
