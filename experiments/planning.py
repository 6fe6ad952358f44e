"""Planning: a finger pushes a rod that it does not touch at the start, by linear models with and without smoothing."""

import copy
import functools
import itertools
import time
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from pydantic import Field, model_validator

import mjxgrad as mg
from experiments.problems.planar_pusher import PlanarPusher, planar_pusher
from experiments.report import Table, tabulated
from experiments.settings import Finite, Positive, RunSettings, VideoSettings
from experiments.theme import DEFAULT, FIRST, REFERENCE, ZEROTH, Drawings, plain, shades, subplots
from experiments.video import film, shown_speed
from experiments.words import capitalised
from experiments.workspace import Workspace
from mjxgrad.planning import Plan, Smoother, optimise_trajectory
from mjxgrad.stepping import Smoothing

Count = Annotated[int, Field(ge=1)]
NAMES = {"analytic": "analytic", "none": "no smoothing"}


class Settings(RunSettings):
    """A rod is pushed to a pose by a finger that does not touch it at the start."""

    # The linear models to compare; figures and video show the first.
    models: Annotated[tuple[Literal["analytic", "none"], ...], Field(min_length=1)] = ("analytic", "none")
    finger: tuple[Finite, Finite] = (0.0, -0.15)  # the finger's start (m)
    goal: tuple[Finite, Finite, Finite]  # the rod's goal: x, y (m) and turn (rad); it starts at the origin
    length: Positive = 0.05  # smoothing of contacts at the start (m)
    last_length: Positive = 0.001  # smoothing of contacts in the last iterations (m)
    num_iterations: Annotated[int, Field(ge=3)] = 60  # iterations of trajectory optimisation
    horizon: Count = 25  # decisions of 0.1 s each
    position_tolerance: Positive = 0.02  # the distance from its goal at which the rod has arrived (m)
    angle_tolerance: Positive = 0.15  # the same for its turn (rad)
    video: VideoSettings | None = None  # without it, none is made

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if self.last_length > self.length:
            raise ValueError("last_length must be at most length: smoothing decreases")
        return self


@dataclass(frozen=True)
class Attempt:
    """The plan by one kind of linear model."""

    model: str  # the kind
    seconds: float  # wall time with compilation
    states: Float[np.ndarray, "states state"]  # the system's, under the controls that were found
    controls: Float[np.ndarray, "horizon 2"]  # finger speeds
    course: dict[str, Float[np.ndarray, " count"]]  # numbers by name along the iterations


@dataclass(frozen=True)
class Outcome:
    """All that was found."""

    settings: Settings
    attempts: list[Attempt]  # in the order of the settings
    shown: Float[np.ndarray, "steps 5"]  # positions under the first plan at every time step, from a rollout of its own
    timestep: float  # between these (s)

    @property
    def goal(self) -> Float[np.ndarray, " 3"]:
        """The rod's pose that is wanted."""
        return np.asarray(self.settings.goal)

    @property
    def best(self) -> Attempt:
        """The plan of the first kind, which figures and video show."""
        return self.attempts[0]

    def distance(self, attempt: Attempt) -> float:
        """Return the distance of the rod from its goal in the end (m)."""
        return float(np.hypot(*(attempt.states[-1, 2:4] - self.goal[:2])))

    def angle(self, attempt: Attempt) -> float:
        """Return the angle between the rod and its goal in the end (rad)."""
        return float(abs(attempt.states[-1, 4] - self.goal[2]))

    def _off(self, state: np.ndarray) -> float:
        """Return how far the rod's worst coordinate is from the goal, in tolerances."""
        near = self.settings.position_tolerance
        return float(np.max(np.abs(state[2:5] - self.goal) / np.array([near, near, self.settings.angle_tolerance])))

    def is_solved(self, attempt: Attempt) -> bool:
        """Return whether the rod is at its goal, as near as the settings ask for."""
        return self._off(attempt.states[-1]) <= 1

    def moved(self, attempt: Attempt) -> float:
        """Return the share of the way to the goal that was made good, in tolerances."""
        return 1 - self._off(attempt.states[-1]) / self._off(attempt.states[0])

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per attempt, for metrics.csv."""
        return [
            {
                "model": attempt.model,
                "is_solved": self.is_solved(attempt),
                "distance_m": self.distance(attempt),
                "angle_rad": self.angle(attempt),
                "final_cost": float(attempt.course["cost"].min()),
                "seconds": attempt.seconds,
            }
            for attempt in self.attempts
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Plan with every kind of linear model that is asked for."""
    task = planar_pusher(finger=settings.finger, goal=settings.goal)
    workspace.check(task.system.scene)
    parts = {model: functools.partial(_attempt, task, settings, model) for model in settings.models}
    attempts = workspace.each("planning", "attempts", parts)
    # The scene itself under the plan's controls, every time step kept.
    system = task.system
    state = mg.initial_state(system.scene, qpos=task.start[: system.scene.model.nq])
    controls = jnp.repeat(jnp.asarray(attempts[0].controls), system.num_substeps, axis=0)
    trajectory = eqx.filter_jit(mg.rollout)(system.scene, state, controls)
    return Outcome(settings, attempts, np.asarray(trajectory.qpos), float(system.scene.model.opt.timestep))


@eqx.filter_jit
def _optimised(task: PlanarPusher, settings: Settings, smoother: Smoother, schedule: np.ndarray) -> Plan:
    return optimise_trajectory(
        task.system,
        task.cost,
        task.start,
        jnp.zeros((settings.horizon, 2)),
        jax.random.key(settings.seed),
        smoother=smoother,
        schedule=schedule,
        lower=-task.speed_limit,
        upper=task.speed_limit,
    )


def _attempt(task: PlanarPusher, settings: Settings, model: str) -> Attempt:
    """Optimise a trajectory from resting controls while the smoothing vanishes."""
    count, last = settings.num_iterations, settings.last_length / settings.length
    still = count // 6
    factors = np.concatenate([np.ones(still), np.geomspace(1, last, count - 2 * still), np.full(still, last)])
    smoother = mg.planning.Analytic(Smoothing(settings.length)) if model == "analytic" else mg.planning.Exact()
    begin = time.perf_counter()
    plan = _optimised(task, settings, smoother, factors)
    seconds, rows = time.perf_counter() - begin, plan.iterations
    course = {
        "length": settings.length * np.asarray(rows.factor),
        "smoothed_cost": np.asarray(rows.smoothed_cost),
        "cost": np.append(plan.start_cost, rows.cost),
        "step": np.asarray(rows.step),
    }
    return Attempt(model, seconds, np.asarray(plan.states), np.asarray(plan.controls), course)


def answer(outcome: Outcome) -> str:
    """Say which linear models solve the task."""
    solved = {one.model: outcome.is_solved(one) for one in outcome.attempts}
    smoothed = [is_solved for model, is_solved in solved.items() if model != "none"]
    said = [f"{'Yes' if any(smoothed) else 'No'}, with smoothed models"] if smoothed else []
    if "none" in solved:
        said.append(f"{'yes' if solved['none'] else 'no'}, with plain ones")
    return f"{capitalised('; '.join(said))}."


def verdict(outcome: Outcome) -> str:
    """Say what each kind of linear model did."""
    return capitalised("; ".join(_one(outcome, attempt) for attempt in outcome.attempts)) + "."


def _one(outcome: Outcome, attempt: Attempt) -> str:
    end = f"{1e3 * outcome.distance(attempt):.1f} mm and {outcome.angle(attempt):.3f} rad"
    if outcome.is_solved(attempt):
        fate = f"reaches its goal to {end}"
    else:
        fate = "does not move at all" if outcome.moved(attempt) == 0 else f"ends {end} from its goal"
    return f"with {NAMES[attempt.model]}{' models' * (attempt.model != 'none')} the rod {fate}"


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the attempts."""
    rows = [
        {
            "linear models": NAMES[attempt.model],
            "solved": "yes" if outcome.is_solved(attempt) else "no",
            "rod from goal": f"{1e3 * outcome.distance(attempt):.1f} mm",
            "turn from goal": f"{outcome.angle(attempt):.3f} rad",
            "iterations without a better step": f"{sum(attempt.course['step'] == 0)} of {len(attempt.course['step'])}",
            "time": f"{attempt.seconds:.0f} s",
        }
        for attempt in outcome.attempts
    ]
    off = max(abs(outcome.shown[-1] - outcome.best.states[-1, :5]))
    caption = (
        f"Every plan. A rollout of the scene under the first one ends where the planner says, up to {off:.0e} (m, rad). "
        "Times include compilation."
    )
    return [tabulated(rows, caption)]


_COLOURS = {"analytic": ZEROTH, "none": DEFAULT}
_HALF_LENGTH, _RADIUS = 0.1, 0.02  # m, of the rod's axis; of rod and finger
_EVERY = 3  # decisions between the poses drawn
_DECISION = 0.1  # s
_MOST_POSES = 9  # in a panel


def drawings(outcome: Outcome) -> Drawings:
    """Draw the figures in order of reading."""
    return {"plane": plane(outcome), "cost": cost(outcome)}


def cost(outcome: Outcome):
    """Draw true and smoothed cost against iterations, beside the smoothing length."""
    figure, axes = subplots(1, 2, height=3.6, width_ratios=[2, 1])
    left, right = axes[0]
    for attempt in outcome.attempts:
        colour = _COLOURS[attempt.model]
        true, smoothed = attempt.course["cost"], attempt.course["smoothed_cost"]
        left.plot(np.arange(len(true)), true, color=colour, lw=2, label=NAMES[attempt.model])
        if attempt.model != "none":
            left.plot(1 + np.arange(len(smoothed)), smoothed, color=colour, lw=0.9)
            right.plot(1 + np.arange(len(smoothed)), 1e3 * attempt.course["length"], color=REFERENCE)
    for axis, title in ((left, "Cost"), (right, "Smoothing length in mm")):
        axis.set(title=title, xlabel="iteration", yscale="log")
        axis.xaxis.get_major_locator().set_params(integer=True)
    left.legend(loc="center right")
    plain(right.yaxis)
    caption = (
        "Left, the cost of the scene itself under the controls of each iteration (thick), and of the smoothed scene that the "
        "iteration works on (thin). Right, the smoothing length. Both costs meet as the smoothing vanishes; a cost that rises "
        "on the way is a plan whose contact existed in the smoothed scene alone. The best controls of all are kept."
    )
    return figure, "Cost against iterations", caption


def plane(outcome: Outcome):
    """Draw rod and finger along the plan."""
    states = outcome.best.states
    shown = [*range(0, len(states) - 1, _EVERY), len(states) - 1]
    # Panels that overlap in one pose: too many on one another hide what happens.
    count = max(1, -(-(len(shown) - 1) // (_MOST_POSES - 1)))
    ends = np.linspace(0, len(shown) - 1, count + 1).round().astype(int)
    parts = [shown[a : b + 1] for a, b in itertools.pairwise(ends)]
    figure, axes = subplots(1, len(parts), height=4.4, sharex=True, sharey=True)
    for axis, part in zip(axes[0], parts, strict=True):
        for number, colour in zip(part, shades(len(part)), strict=True):
            _rod(axis, states[number, 2:5], color=colour, alpha=0.55)
            axis.add_patch(Circle(tuple(states[number, :2]), _RADIUS, color=colour))
        axis.plot(*states[part[0] : part[-1] + 1, :2].T, color=FIRST, lw=1.2)
        _rod(axis, outcome.goal, facecolor="none", edgecolor=REFERENCE, ls="--", lw=1.2)
        axis.add_patch(Circle(tuple(states[part[0], :2]), _RADIUS, facecolor="none", edgecolor=FIRST, lw=1.5))
        axis.set(title=f"{part[0] * _DECISION:.1f} to {part[-1] * _DECISION:.1f} s", xlabel="x in m", aspect="equal")
    axes[0, 0].set_ylabel("y in m")
    axes[0, 0].autoscale_view()
    caption = (
        "Rod and finger every 0.3 s and at the end, from faint to strong; the dashed outline is the goal, the ring where the "
        "finger starts."
    )
    return figure, "The plan, seen from above", caption


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the plan with the goal as a shade; return the file and its caption."""
    mj_model = copy.copy(planar_pusher().system.scene.mj_model)
    target = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, "target")
    x, y, turn = outcome.goal
    mj_model.body_pos[target] = [x, y, mj_model.body_pos[target, 2]]
    mj_model.body_quat[target] = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
    still = np.repeat(outcome.shown[-1:], int(1 / outcome.timestep * wanted.speed), axis=0)
    motion = mj_model, np.concatenate([outcome.shown, still])
    caption = f"The plan on the scene itself, {shown_speed(wanted.speed)}; the goal in a light shade."
    return film(workspace, [motion], wanted, camera="above", caption=caption, timestep=outcome.timestep)


def _rod(axis: Axes, pose: np.ndarray, **look) -> None:
    """Draw a capsule as the outline of two half circles."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 20)
    right = np.stack([_HALF_LENGTH + _RADIUS * np.cos(angle), _RADIUS * np.sin(angle)])
    outline = np.concatenate([right, -right], axis=1)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = np.array([[cos, -sin], [sin, cos]]) @ outline + pose[:2, None]
    axis.fill(x, y, **({"lw": 0} | look))  # pyright: ignore[reportArgumentType]
    # The end that the scene paints in another colour tells one half turn from the other.
    axis.plot(pose[0] + cos * _HALF_LENGTH, pose[1] + sin * _HALF_LENGTH, ".", color=REFERENCE, ms=3)
