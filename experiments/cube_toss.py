"""A thrown cube: error of a derivative against processor time, for time steps and methods."""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from pydantic import Field

import mjxgrad as mg
from experiments.config import ExperimentError
from experiments.motion import advance, at_time_step
from experiments.problems.integration import adaptive_rollout
from experiments.report import Table
from experiments.settings import Positive, RunSettings
from experiments.theme import FIRST, MUTED, ONSET, ZEROTH, Drawings, legend_below, subplots
from experiments.words import capitalised, joined, percent, quantity
from experiments.workspace import Workspace
from mjxgrad._mjx import mjx
from mjxgrad.rollouts.state import data_of
from mjxgrad.tasks import scene_path


class Settings(RunSettings):
    """Error of a derivative against processor time, for time steps and methods."""

    contacts: Annotated[tuple[Literal["published", "default"], ...], Field(min_length=1)] = ("published", "default")
    """Of the cube with the floor: as DiffMJX published it, whose force begins continuously, or MuJoCo's default."""
    timesteps: Annotated[tuple[Positive, ...], Field(min_length=2)]
    """For discrete and slopes at MuJoCo's motion and contact that begins within the step, in s; each must divide a second."""
    tolerances: Annotated[tuple[Positive, ...], Field(min_length=1)]
    """Of the adaptive integration."""


DURATION = 1.0  # s
PUBLISHED_SPEED = -2.0  # m/s, upwards
PUBLISHED_DERIVATIVE = 0.17267  # m per m/s
_DRIFT = -0.1  # m/s, sideways

# (solref, solimp): what DiffMJX was timed on, whose force begins without a jump, and what MuJoCo takes if nothing is said.
_CONTACTS = {
    "published": ((0.005, 1.0), (0.0, 0.95, 0.001, 0.5, 2.0)),
    "default": ((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)),
}

# Throws at slightly different speed, over which the error is taken, for single derivatives depend on chance (m/s).
_SPEEDS = PUBLISHED_SPEED + 0.005 * (np.arange(4) / 4 - 0.5)
# Half the step of the reference's difference quotient (m/s), and its tolerance.
_STEP, _TOLERANCE = 1e-4, 1e-10


class CubeToss(eqx.Module):
    """The throw; see `cube_toss`."""

    scene: mg.Scene

    def start(self, speed: Float[ArrayLike, ""]) -> mg.State:
        """Return the state at a throw upwards at a speed in m/s."""
        qvel = jnp.zeros_like(self.scene.data.qvel).at[1].set(_DRIFT).at[2].set(speed)
        return mg.initial_state(self.scene, qvel=qvel)

    def outcome(self, qpos: Float[Array, "*states 7"]) -> Float[Array, "*states"]:
        """Return how far sideways the cube is, in m."""
        return qpos[..., 1]


def cube_toss(contact: str = "published", *, timestep: float | None = None) -> CubeToss:
    """Load the throw, with contact whose force begins without a jump or with one; `timestep` (s) is the scene's if None."""
    scene = mg.load_scene(scene_path("cube_toss"), timestep=timestep)
    solref, solimp = (jnp.array([row]) for row in _CONTACTS[contact])
    return CubeToss(scene.with_model(pair_solref=solref, pair_solimp=solimp))


# From a throw, its speed and a time step or tolerance to a derivative, the number of steps, and whether it failed.
Derivative = Callable[[CubeToss, Array, Array], tuple[Array, Array, Array]]
METHODS = {
    "discrete": "discrete",
    "slope": "slope",
    "continuous": "contact that begins within the step",
    "adaptive": "adaptive, differentiated",
    "quotient": "adaptive, difference quotient",
}
_SHORT = {
    "discrete": "plain step",
    "slope": "slope at MuJoCo's motion",
    "continuous": "continuous onset",
    "adaptive": "adaptive steps",
    "quotient": "difference quotient",
}
CONTACTS = {"published": "contact whose force begins continuously", "default": "MuJoCo's default contact"}


@dataclass(frozen=True)
class Point:
    """One method, a key of `METHODS`, at one setting, a time step in s or a tolerance.

    Derivatives are in m per m/s, one of each throw; seconds are the processor time of one, compiled, and the wall time of the
    first call, which compiles unless an earlier setting did.
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
    """All methods with one contact, a key of `CONTACTS`; errors are shares of the derivative, whose reference is by throw."""

    contact: str
    reference: Float[np.ndarray, " throws"]
    points: tuple[Point, ...]

    @property
    def scale(self) -> float:
        return float(np.abs(self.reference).mean())

    def of(self, method: str) -> list[Point]:
        """Give the points of a method, from accurate to coarse."""
        return sorted((point for point in self.points if point.method == method), key=lambda point: point.setting)

    def errors(self, point: Point) -> Float[np.ndarray, " throws"]:
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


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Take the derivative of every throw by every method."""
    for timestep in settings.timesteps:
        if abs(DURATION / timestep - round(DURATION / timestep)) > 1e-6:
            raise ExperimentError(f"timesteps must divide {DURATION:g} s, got {timestep:g}")
    jobs = [(name, h) for name in ("discrete", "slope", "continuous") for h in settings.timesteps]
    jobs += [(name, tolerance) for name in ("adaptive", "quotient") for tolerance in settings.tolerances]
    courses = []
    with workspace.stage("derivatives", "points", len(settings.contacts) * (1 + len(jobs))) as advance_to:
        for contact in settings.contacts:
            task = cube_toss(contact)
            workspace.check(task.scene, name=f"cube, {contact} contact")
            reference, _, failed = _taken(_DERIVATIVES["quotient"], task, jnp.asarray(_TOLERANCE))
            if bool(np.any(failed)):
                raise ExperimentError(f"the reference with {contact} contact needs more steps than it may take")
            points = []
            for name, setting in jobs:
                take = functools.partial(_point, name, task, setting)
                points.append(workspace.once(f"{contact} {name} {setting}", take))
                advance_to(len(courses) * (1 + len(jobs)) + 1 + len(points))
            courses.append(Course(contact, np.asarray(reference), tuple(points)))
    return Outcome(tuple(courses))


def _point(name: str, task: CubeToss, setting: float) -> Point:
    def call():
        return jax.block_until_ready(_taken(_DERIVATIVES[name], task, jnp.asarray(setting)))

    started = time.perf_counter()
    derivative, num_steps, failed = call()
    first = time.perf_counter() - started
    # Processor time: what else runs on the machine does not count.
    begun = time.process_time()
    call()
    spent = time.process_time() - begun
    seconds, steps = spent / len(_SPEEDS), float(np.mean(num_steps))
    return Point(name, setting, np.asarray(derivative), seconds, first, steps, bool(np.any(failed)))


@eqx.filter_jit
def _taken(derivative: Derivative, task: CubeToss, setting: Array):
    """Take the throws one after the other, for under `jax.vmap` all would take the short steps at every event.

    One program per method serves every contact and time step.
    """
    return jax.lax.map(lambda speed: derivative(task, speed, setting), jnp.asarray(_SPEEDS))


def _by_steps(
    step: Callable[[mjx.Model, mjx.Data], mjx.Data], task: CubeToss, speed: Array, timestep: Array
) -> tuple[Array, Array, Array]:
    """Forward mode through steps whose length and number are traced."""
    model = at_time_step(task.scene.model, timestep)

    def end(speed: Array) -> Array:
        start = data_of(task.scene, task.start(speed), task.scene.data.ctrl)
        count = jnp.round(DURATION / timestep).astype(int)
        return task.outcome(advance(functools.partial(step, model), start, count).qpos)

    return jax.jvp(end, (speed,), (jnp.ones_like(speed),))[1], DURATION / timestep, jnp.zeros((), bool)


def _adaptive_end(task: CubeToss, speed: Array, tolerance: Array) -> tuple[Array, tuple[Array, Array]]:
    found = adaptive_rollout(task.scene, task.start(speed), jnp.array([DURATION]), tolerance=tolerance, max_steps=2**16)
    return task.outcome(found.qpos[-1]), (found.num_steps, found.has_failed)


def _adaptive(task: CubeToss, speed: Array, tolerance: Array) -> tuple[Array, Array, Array]:
    derivative, (num_steps, failed) = jax.grad(_adaptive_end, argnums=1, has_aux=True)(task, speed, tolerance)
    return derivative, num_steps.astype(float), failed


def _quotient(task: CubeToss, speed: Array, tolerance: Array) -> tuple[Array, Array, Array]:
    ends, (num_steps, failed) = jax.lax.map(
        lambda at: _adaptive_end(task, at, tolerance), jnp.stack([speed - _STEP, speed + _STEP])
    )
    return (ends[1] - ends[0]) / (2 * _STEP), jnp.sum(num_steps).astype(float), jnp.any(failed)


_DERIVATIVES: dict[str, Derivative] = {
    "discrete": functools.partial(_by_steps, functools.partial(mg.step, contact=mg.Discrete())),
    "slope": functools.partial(_by_steps, functools.partial(mg.step, contact=mg.Slope())),
    "continuous": functools.partial(_by_steps, functools.partial(mg.step, contact=mg.Onset())),
    "adaptive": _adaptive,
    "quotient": _quotient,
}


# Share of the derivative that the verdict asks for.
TARGET = 0.02


def fastest(course: Course) -> Point | None:
    """Give the fastest point from which on its method stays below the target; None if there is none."""
    found = []
    for method in METHODS:
        # One lucky coarse point between bad ones does not count.
        for point in course.of(method):
            if course.error(point) > TARGET:
                break
            found.append(point)
    return min(found, key=lambda one: one.seconds, default=None)


def answer(outcome: Outcome) -> str:
    """Give the price of the cheapest right derivative by contact, and its way; without any the nearest."""
    if not any(map(fastest, outcome.courses)):
        errors = [(c.error(p), p.method) for c in outcome.courses for p in c.points if np.isfinite(c.error(p))]
        if not errors:
            return "None: every derivative fails."
        error, method = min(errors)
        return f"None comes within {TARGET:.0%}; the nearest, {_SHORT[method]}, is {percent(error)} off."
    return "; ".join(_price(course) for course in outcome.courses) + "."


def _price(course: Course) -> str:
    first = fastest(course)
    contact = {"published": "Continuous force", "default": "MuJoCo's default"}[course.contact]
    if first is None:
        return f"{contact}: none within {TARGET:.0%}"
    return f"{contact}: {first.seconds:.2g} s, {_SHORT[first.method]}"


def verdict(outcome: Outcome) -> str:
    """Say what reaches the wanted error soonest, and what never does."""
    return " ".join(_verdict(course) for course in outcome.courses)


def _verdict(course: Course) -> str:
    first, contact = fastest(course), CONTACTS[course.contact]
    best = {method: min((course.error(p) for p in course.of(method)), default=np.inf) for method in METHODS}
    never = [METHODS[method] for method in ("discrete", "adaptive") if best[method] > 0.2]
    if first is None:
        closest = min(best, key=lambda method: best[method])
        head = f"nothing stays below {TARGET:.0%}; the closest is {METHODS[closest]} ({_percent(best[closest])})"
    else:
        setting = f"tolerance {first.setting:g}"
        if first.method not in ("adaptive", "quotient"):
            setting = f"time step {first.setting:g} s"
        head = (
            f"the first below {TARGET:.0%} is {METHODS[first.method]} ({setting}): {_percent(course.error(first))} in "
            f"{first.seconds:.2g} s of processor time"
        )
    if never:
        head += f"; {joined(never)} {'stays' if len(never) == 1 else 'stay'} above 20% at every setting"
    return f"With {contact} {head}."


def findings(outcome: Outcome) -> list[str]:
    """Say what DiffMJX published."""
    return [
        f"DiffMJX published the derivative {PUBLISHED_DERIVATIVE:g} for these measures, and 1.9% error in 9.2 s after 67 s of "
        f"compilation; here it is {quantity(course.scale)} (C MuJoCo's steps of 10 µs give 0.571). That simulator softens "
        "collisions and lets contacts act from a distance, and ran on other hardware: its times stand beside ours, not for the "
        "same problem."
        for course in outcome.courses
        if course.contact == "published"
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all points."""
    rows, emphasised = [], set()
    for course in outcome.courses:
        first = fastest(course)
        for point in course.points:
            if point is first:
                emphasised.add((len(rows), 3))
            errors = map(_percent, (course.error(point), float(course.errors(point).mean())))
            costs = f"{point.seconds:.3g}", f"{point.first_seconds:.0f}", f"{point.num_steps:.0f}"
            rows.append([course.contact, METHODS[point.method], f"{point.setting:g}", *errors, *costs])
    columns = (
        "contact", "method", "time step (s) or tolerance", "error", "bias", "processor time, s", "first call, s", "steps"
    )  # fmt: skip
    caption = (
        "Error: root mean square over throws, of a single derivative, as a share of the derivative; bias: its mean. "
        "Reference: difference quotient of adaptive rollouts at tolerance 1e-10. The first call takes all throws and "
        "compiles, unless an earlier setting did or it was cached. In bold the "
        f"fastest whose method stays below {TARGET:.0%} from there on."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _percent(share: float) -> str:
    return percent(share).replace("-", "−") if np.isfinite(share) else "failed"


_LOOKS = {
    "discrete": {"color": FIRST, "marker": "o"},
    "slope": {"color": ZEROTH, "marker": "s"},
    "continuous": {"color": ONSET, "marker": "D"},
    "adaptive": {"color": "#e69f00", "marker": "v"},
    "quotient": {"color": "#56b4e9", "marker": "P"},
}
# DiffMJX's own table (one run each, other hardware): name, relative error to its reference, seconds.
DIFFMJX = (("Euler 1 ms", 17.77, 3.29), ("Euler 30 µs", 0.0277, 102.5), ("Bosh3 1e-5", 0.0187, 9.20))


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"error": error}


def error(outcome: Outcome):
    """Error of a single derivative against processor time, one panel per contact."""
    figure, axes = subplots(1, len(outcome.courses), height=4.6, sharey=True)
    for axis, course in zip(axes[0], outcome.courses, strict=True):
        for method, label in METHODS.items():
            points = _finite(course, method)
            errors = [course.error(point) for point in points]
            axis.plot([point.seconds for point in points], errors, ms=5, lw=1.3, label=label, **_LOOKS[method])
        for name, value, seconds in DIFFMJX if course.contact == "published" else ():
            axis.plot(seconds, value, "x", color=MUTED, ms=6, mew=1.5)
            axis.annotate(
                f"DiffMJX, {name}", (seconds, value), (-4, 6),
                textcoords="offset points", fontsize=8, color=MUTED, ha="right",
            )  # fmt: skip
        axis.axhline(TARGET, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        axis.set(xscale="log", yscale="log", xlabel="processor time of one derivative, s")
    axes[0, 0].set_ylabel("relative error of one derivative")
    caption = (
        "Root-mean-square error of a single derivative over four throws, as a share of the derivative, against its processor "
        "time without compilation. Along a line the time step or the tolerance gets smaller to the right. Grey: what DiffMJX "
        "published for its own simulator, on other hardware and against its own reference. Dotted: the error that the "
        "verdict asks for."
    )
    return _finished(figure, axes[0], outcome), "Error against time", caption


def _finite(course: Course, method: str) -> list[Point]:
    return [point for point in reversed(course.of(method)) if np.isfinite(course.error(point))]


def _finished(figure, axes: np.ndarray, outcome: Outcome):
    for axis, course in zip(axes, outcome.courses, strict=True):
        axis.set_title(capitalised(CONTACTS[course.contact]))
    legend_below(figure, axes[0], 3)
    return figure
