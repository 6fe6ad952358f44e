"""A hand turns a body: a tree on smoothed linear models, beside one without smoothing and plain trajectory optimisation."""

import copy
import functools
import subprocess
import time
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from pydantic import Field

import mjxgrad as mg
from experiments.config import ExperimentError
from experiments.report import Table
from experiments.settings import Positive, RunSettings, SettingsTable, VideoSettings
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.video import film, shown_speed
from experiments.words import capitalised
from experiments.workspace import Workspace
from mjxgrad.planning import Exact, GoalCost, Sampled, SceneSystem, Tree, optimise_trajectory
from mjxgrad.tasks import scene_path

Arm = Literal["smoothed", "unsmoothed", "trajectory"]
NAMES = {"smoothed": "smoothed tree", "unsmoothed": "unsmoothed tree", "trajectory": "trajectory optimisation"}
_COLOURS = {"smoothed": ZEROTH, "unsmoothed": FIRST, "trajectory": DEFAULT}
_POLISH, _HORIZON = 10, 20  # iterations after a tree; of trajectory optimisation alone twice as many, of so many steps


class Sizes(SettingsTable):
    """How much is searched."""

    num_seeds: Annotated[int, Field(ge=1)] = 10
    """Searches by each arm."""
    capacity: Annotated[int, Field(ge=32)] = 3000
    """Most nodes of a tree."""
    max_seconds: Positive = 60.0
    """Most time of a search, without compilation (s)."""


class Settings(RunSettings):
    """A body is turned about an axis by a hand, over several seeds."""

    hand: Literal["planar", "shadow"]
    """Two fingers and a disc in a plane, or the Shadow hand with a block of gymnasium-robotics, which is downloaded."""
    arms: Annotated[tuple[Arm, ...], Field(min_length=1)] = ("smoothed", "unsmoothed", "trajectory")
    """What is compared; figures and video show the first."""
    angle: Positive
    """Turn of the goal (degrees)."""
    angle_tolerance: Positive = 6.0
    """Distance from it that counts as reached (degrees)."""
    position_tolerance: Positive = 0.03
    """The same for the place of the body (m)."""
    stddev: Positive = 0.3
    """Of the noise on the servos' targets (rad)."""
    num_samples: Annotated[int, Field(ge=6)] = 24
    """Steps of a smoothed linear model."""
    reach: Positive = 0.4
    """Most change of a servo's target in a step (rad)."""
    num_substeps: Annotated[int, Field(ge=1)] = 20
    """Time steps of a step."""
    size: Literal["default", "quick"] = "default"
    """Which of the sizes."""
    sizes: Sizes = Sizes()
    """One of the tables, by the size."""
    video: VideoSettings | None = VideoSettings(speed=0.5, width=480, height=360)
    """Of the first path found by the first arm."""


@dataclass(frozen=True)
class Problem:
    """A hand at rest, and the coordinates of a change that its body has."""

    model: mujoco.MjModel
    start: Float[np.ndarray, " state"]
    control: Float[np.ndarray, " m"]  # that holds the start
    place: slice
    turn: slice  # rotations, the last of which is to change

    def changes(self, hand: float, place: float, turn: float, rest: float) -> Float[np.ndarray, " n"]:
        """Return one number per coordinate of a change: of the hand, the body's place and rotation, and the velocities."""
        found = np.full(2 * self.model.nv, rest)
        found[: self.place.start], found[self.place], found[self.turn] = hand, place, turn
        return found


@dataclass(frozen=True)
class Attempt:
    """What one arm found from one seed."""

    arm: Arm
    seed: int
    course: Float[np.ndarray, " nodes"]  # least distance from the goal in tolerances, against nodes
    points: Float[np.ndarray, "nodes 2"]  # displacement (m) and turn (degrees) of each node's body
    parents: np.ndarray
    states: Float[np.ndarray, "steps nq"]  # positions at every time step of the replay, by plain C MuJoCo
    error: float  # of the replay's end, in tolerances
    angle_error: float  # of the same, degrees
    num_steps: int  # steps of the path
    seconds: float  # of the search, without compilation
    polish_seconds: float  # with compilation

    @property
    def is_solved(self) -> bool:
        """Whether the replay ends at the goal."""
        return self.error <= 1


@dataclass(frozen=True)
class Outcome:
    """All that was found."""

    settings: Settings
    attempts: list[Attempt]

    def of(self, arm: Arm) -> list[Attempt]:
        """Return the attempts of one arm."""
        return [one for one in self.attempts if one.arm == arm]

    def solved(self, arm: Arm) -> str:
        """Count the seeds from which an arm's replay ends at the goal."""
        return f"{sum(one.is_solved for one in self.of(arm))} of {len(self.of(arm))}"

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per attempt, for metrics.csv."""
        names = ("arm", "seed", "is_solved", "error", "angle_error", "num_steps", "seconds", "polish_seconds")
        return [{name: getattr(one, name) for name in names} | {"nodes": len(one.course)} for one in self.attempts]


def problem_of(settings: Settings) -> Problem:
    """Return the hand at rest, before any touch of the disc or with the block on its palm."""
    if settings.hand == "planar":
        model, control = (
            mujoco.MjModel.from_xml_path(str(scene_path("planar_hand"))),
            np.array([0.35, -0.75, -0.35, 0.75]),
        )
        return Problem(model, np.concatenate([control, np.zeros(3 + model.nv)]), control, slice(4, 6), slice(6, 7))
    from experiments.robots import fetched

    try:
        folder = fetched("gymnasium-robotics") / "gymnasium_robotics/envs/assets/hand"
    except (subprocess.CalledProcessError, OSError) as error:
        raise ExperimentError(f"the hand of gymnasium-robotics could not be downloaded: {error}") from error
    spec = mujoco.MjSpec.from_file(str(folder / "manipulate_block.xml"))
    # The goal of gymnasium's own tasks is a free body that falls.
    spec.delete(spec.joint("target:joint"))
    spec.worldbody.add_camera(name="above", pos=[0.855, 0.649, 0.515], alt=_look([0.866, -0.5, 0, 0.383, 0.663, 0.643]))
    data = mujoco.MjData(model := spec.compile())
    curled = [model.actuator(i).name[-3:] in ("FJ2", "FJ1") for i in range(model.nu)]
    data.ctrl[:] = 0.5 * np.array(curled)
    mujoco.mj_step(model, data, 1500)
    start = np.concatenate([data.qpos, np.zeros(model.nv)])
    return Problem(model, start, data.ctrl.copy(), slice(24, 27), slice(27, 30))


def _look(axes: list[float]) -> mujoco.MjsOrientation:
    found = mujoco.MjsOrientation()
    found.type, found.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, axes
    return found


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Search by every arm from every seed."""
    problem, sizes = problem_of(settings), settings.sizes
    system = SceneSystem(mg.load_scene(problem.model, engine="mujoco"), num_substeps=settings.num_substeps)  # pyright: ignore
    turned = jnp.zeros(system.num_changes).at[problem.turn.stop - 1].set(np.deg2rad(settings.angle))
    goal = np.asarray(system.retract(jnp.asarray(problem.start), turned))
    attempts, trees = (
        [],
        {arm: _tree(problem, system, goal, settings, arm) for arm in settings.arms if arm != "trajectory"},
    )
    with workspace.stage("search", "attempts", len(settings.arms) * sizes.num_seeds) as advance_to:
        for seed in range(settings.seed, settings.seed + sizes.num_seeds):
            for arm in settings.arms:
                compute = functools.partial(_attempt, problem, system, goal, settings, trees.get(arm), arm, seed)
                attempts.append(workspace.once(f"{arm} {seed}", compute))
                advance_to(len(attempts))
    return Outcome(settings, attempts)


def _tree(problem: Problem, system: SceneSystem, goal: np.ndarray, settings: Settings, arm: str) -> Tree:
    angle, near = np.deg2rad(settings.angle_tolerance), settings.position_tolerance
    upper = problem.changes(1.0, near, 3 * angle, 0.0)
    lower = -upper
    upper[problem.turn.stop - 1] += np.deg2rad(settings.angle)
    return Tree(
        system, goal, problem.changes(np.inf, near, angle, np.inf), lower=lower, upper=upper, reach=settings.reach,
        resolution=problem.changes(0.2, 0.02, 0.1, np.inf),
        smoother=Exact() if arm == "unsmoothed" else Sampled(None, settings.stddev, settings.num_samples),
    )  # fmt: skip


def _attempt(
    problem: Problem, system: SceneSystem, goal: np.ndarray, settings: Settings, tree: Tree | None, arm: Arm, seed: int
) -> Attempt:
    key, sizes = jax.random.key(seed), settings.sizes
    tolerance = np.deg2rad(settings.angle_tolerance)
    weight = problem.changes(0.0, settings.position_tolerance**-2, tolerance**-2, 0.0)
    cost = GoalCost(goal, 0.0, weight, 1e-3)
    course, points, parents, seconds = np.array([np.inf]), np.zeros((1, 2)), np.array([-1]), 0.0
    if tree is None:
        controls = problem.control + 0.1 * settings.reach * jax.random.normal(key, (_HORIZON, len(problem.control)))
    else:
        found = tree.search(problem.start, problem.control, key, capacity=sizes.capacity, max_seconds=sizes.max_seconds)
        controls, seconds, parents = found.controls, found.seconds, found.parents
        course, away = np.minimum.accumulate(found.errors), _changes(problem, found.nodes, problem.start)
        points = np.stack(
            [np.linalg.norm(away[:, problem.place], axis=1), np.rad2deg(away[:, problem.turn.stop - 1])], axis=1
        )
    began = time.perf_counter()
    if len(controls) and (tree is None or course[-1] <= 1):
        schedule = np.ones(_POLISH if tree else 2 * _POLISH)
        controls = optimise_trajectory(
            system, cost, problem.start, controls, key, smoother=Exact(), schedule=schedule
        ).controls
    polish_seconds, states = time.perf_counter() - began, replayed(problem, np.asarray(controls), settings.num_substeps)
    off = _changes(problem, states[-1:], goal)[0]
    limits = problem.changes(np.inf, settings.position_tolerance, tolerance, np.inf)[: problem.model.nv]
    error, angle = float(np.max(np.abs(off) / limits)), float(np.rad2deg(np.linalg.norm(off[problem.turn])))
    return Attempt(arm, seed, course, points, parents, states, error, angle, len(controls), seconds, polish_seconds)


def _changes(problem: Problem, states: np.ndarray, start: np.ndarray) -> Float[np.ndarray, "states nv"]:
    """Return the changes of positions from a start, by C MuJoCo."""
    found, nq = np.zeros((len(states), problem.model.nv)), problem.model.nq
    for change, state in zip(found, states, strict=True):
        mujoco.mj_differentiatePos(problem.model, change, 1.0, start[:nq], state[:nq])
    return found


def replayed(problem: Problem, controls: np.ndarray, num_substeps: int) -> Float[np.ndarray, "steps nq"]:
    """Return the positions at every time step of plain C MuJoCo under controls."""
    data, nq = mujoco.MjData(problem.model), problem.model.nq
    data.qpos[:], data.qvel[:] = problem.start[:nq], problem.start[nq:]
    states = [data.qpos.copy()]
    for data.ctrl[:] in np.repeat(controls, num_substeps, axis=0):
        mujoco.mj_step(problem.model, data)
        states.append(data.qpos.copy())
    return np.array(states)


def answer(outcome: Outcome) -> str:
    """Count the seeds from which each arm turns the body."""
    return capitalised(", ".join(f"{NAMES[arm]} {outcome.solved(arm)}" for arm in outcome.settings.arms)) + "."


def verdict(outcome: Outcome) -> str:
    """Say how much each arm needed, and how exactly its paths end."""
    said = []
    for arm in outcome.settings.arms:
        good = [one for one in outcome.of(arm) if one.is_solved]
        nodes = np.median([len(one.course) for one in good]) if good else 0
        searched = (
            f", in the median after {nodes:.0f} nodes and {np.median([one.seconds for one in good]):.1f} s"
            if nodes > 1
            else ""
        )
        ends = (
            f"; the angle of their replay is off by {np.median([one.angle_error for one in good]):.2g}°" if good else ""
        )
        said.append(f"{NAMES[arm]}: {outcome.solved(arm)} turn the body by {outcome.settings.angle:g}°{searched}{ends}")
    return ". ".join(map(capitalised, said)) + "."


def findings(outcome: Outcome) -> list[str]:
    """Say how far trajectory optimisation comes, and what a replay is."""
    stuck = [one.angle_error for one in outcome.of("trajectory") if not one.is_solved]
    far = (
        [f"Trajectory optimisation ends {min(stuck):.0f} to {max(stuck):.0f}° from the goal where it fails."]
        if stuck
        else []
    )
    return [*far, "What counts is the replay of the controls by plain C MuJoCo, from the start to the last time step."]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the attempts."""
    columns = ("arm", "seed", "solved", "nodes", "search", "polish", "steps", "angle off", "worst, in tolerances")
    rows = [
        [NAMES[one.arm], str(one.seed), "yes" if one.is_solved else "no", str(len(one.course)), f"{one.seconds:.1f} s",
         f"{one.polish_seconds:.1f} s", str(one.num_steps), f"{one.angle_error:.2f}°", f"{one.error:.2f}"]
        for one in outcome.attempts
    ]  # fmt: skip
    return [Table(columns, rows, "Every attempt; times of search without compilation, of polishing with it.")]


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"tree": figure}


def figure(outcome: Outcome):
    """Draw the distance from the goal against nodes, and one tree."""
    picture, axes = subplots(1, 2, height=4.6)
    left, right = axes[0]
    for arm in outcome.settings.arms:
        for number, one in enumerate(outcome.of(arm) if arm != "trajectory" else ()):
            nodes = 1 + np.arange(len(one.course))
            left.plot(nodes, one.course, color=_COLOURS[arm], lw=1.2, label=NAMES[arm] if number == 0 else None)
            left.plot(nodes[-1], one.course[-1], "o" if one.course[-1] <= 1 else "x", color=_COLOURS[arm], ms=5)
    left.axhline(1.0, color=MUTED, lw=1.0, ls=(0, (1, 2)))
    left.set(title="Distance of the nearest node, in tolerances", xlabel="nodes", xscale="log", yscale="log")
    shown = _shown(outcome)
    x, y = 1e3 * shown.points[:, 0], shown.points[:, 1]
    for child, parent in enumerate(shown.parents):
        if parent >= 0:
            right.plot(x[[parent, child]], y[[parent, child]], color=MUTED, lw=0.5, alpha=0.6)
    line = [int(np.argmin(shown.course))]
    while shown.parents[line[-1]] >= 0:
        line.append(int(shown.parents[line[-1]]))
    right.plot(x[line], y[line], ".-", color=_COLOURS[shown.arm], lw=2)
    right.axhline(outcome.settings.angle, color=MUTED, lw=1.0, ls=(0, (1, 2)))
    right.plot(x[0], y[0], "s", color=REFERENCE, ms=6)
    right.set(title="A tree and its path", xlabel="displacement of the body, mm", ylabel="turn, degrees")
    legend_below(picture, left, 3)
    caption = (
        "Left, one curve per seed; a dot is a goal that was reached, a cross one that was not. "
        f"Right, the nodes of seed {shown.seed} of the {NAMES[shown.arm]}, in the plane of the body's displacement and turn; the "
        "square is the start, the dotted line the goal's angle."
    )
    return picture, "How trees reach the goal", caption


def _shown(outcome: Outcome) -> Attempt:
    mine = outcome.of(outcome.settings.arms[0])
    return next((one for one in mine if one.is_solved), mine[0])


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the replay, with the goal beside it; return the file and its caption."""
    shown, problem = _shown(outcome), problem_of(outcome.settings)
    model, turn = copy.copy(problem.model), np.deg2rad(outcome.settings.angle)
    target = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "target")
    model.body_quat[target] = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
    if outcome.settings.hand == "shadow":
        model.body_pos[target] = [1.1, 0.8, 0.2]
    rest = np.repeat(shown.states[-1:], int(wanted.speed / model.opt.timestep), axis=0)
    caption = (
        f"The path of seed {shown.seed}, replayed by C MuJoCo, {shown_speed(wanted.speed)}; the goal as a light shade."
    )
    return film(workspace, [(model, np.concatenate([shown.states, rest]))], wanted, camera="above", caption=caption)
