"""A hand turns a body: a tree on smoothed linear models, beside one without smoothing and plain trajectory optimisation."""

import copy
import functools
import itertools
import subprocess
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from pydantic import Field

import mjxgrad as mg
from experiments.config import ExperimentError
from experiments.report import Table
from experiments.settings import Positive, RunSettings, SettingsTable, VideoSettings
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.video import film, shown_speed
from experiments.workspace import Workspace
from mjxgrad.planning import Exact, GoalCost, Sampled, SceneSystem, Tree, optimise_trajectory
from mjxgrad.tasks import scene_path

SMOOTHED, UNSMOOTHED, ALONE = "smoothed tree", "unsmoothed tree", "trajectory optimisation"
ARMS = (SMOOTHED, UNSMOOTHED, ALONE)
_APART = np.array([0.35, -0.75, -0.35, 0.75])  # rad, of fingers beside the disc
_REACH, _STDDEV = 0.4, 0.3  # rad, of a servo's target: most change in a step, and noise of the smoothed models
_HORIZON = 20  # steps of trajectory optimisation alone


class Sizes(SettingsTable):
    """How much is searched."""

    num_seeds: Annotated[int, Field(ge=1)] = 6  # searches by each arm
    capacity: Annotated[int, Field(ge=32)] = 2000  # most nodes of a tree
    max_seconds: Positive = 30.0  # most time of a search, without compilation (s)


class Settings(RunSettings):
    """A body is turned about an axis by a hand, over several seeds."""

    # Two fingers and a disc in a plane, or the Shadow hand with a block of gymnasium-robotics, which is downloaded.
    hand: Literal["planar", "shadow"]
    angle: Positive  # turn of the goal (degrees)
    angle_tolerance: Positive = 6.0  # distance from it that counts as reached (degrees)
    position_tolerance: Positive = 0.03  # the same for the place of the body (m)
    # Samples of a tree at a time; where steps are slow, fewer make it deeper in the same time.
    batch: Annotated[int, Field(ge=1)] = 16
    # Iterations of trajectory optimisation after a tree; alone twice as many.
    num_iterations: Annotated[int, Field(ge=1)] = 10
    size: Literal["default", "quick"] = "default"  # which of the sizes
    sizes: Sizes = Sizes()  # one of the tables, by the size
    video: VideoSettings | None = VideoSettings(speed=0.5, width=480, height=360)  # of a path of the smoothed tree


@dataclass(frozen=True)
class Attempt:
    """What one arm found from one seed."""

    arm: str
    seed: int
    course: np.ndarray  # least distance from the goal in tolerances, against nodes
    points: np.ndarray  # displacement (m) and turn (degrees) of each node's body
    parents: np.ndarray  # of nodes
    states: np.ndarray  # at every time step of the replay, by plain C MuJoCo
    error: float  # of the replay's end, in tolerances
    angle_error: float  # of the same, degrees
    num_steps: int  # of the path
    seconds: float  # of the search, without compilation


@dataclass(frozen=True)
class Outcome:
    """All that was found."""

    settings: Settings
    attempts: list[Attempt]

    def of(self, arm: str, *, solved: bool = False) -> list[Attempt]:
        """Return the attempts of one arm, or those whose replay ends at the goal."""
        return [one for one in self.attempts if one.arm == arm and (one.error <= 1 or not solved)]

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per attempt, for metrics.csv."""
        names = ("arm", "seed", "error", "angle_error", "num_steps", "seconds")
        return [{name: getattr(one, name) for name in names} | {"nodes": len(one.course)} for one in self.attempts]


class Problem:
    """A hand at rest: of the planar one nothing touches, on the palm of the other lies a block."""

    def __init__(self, settings: Settings):
        """Load the hand, and turn the goal."""
        is_planar = settings.hand == "planar"
        planar = str(scene_path("planar_hand")), _APART, np.concatenate([_APART, np.zeros(3)])
        source, self.control, start = planar if is_planar else _block()
        scene = mg.load_scene(source, engine="mujoco")
        self.system = SceneSystem(scene, num_substeps=20 if is_planar else 50)  # pyright: ignore[reportCallIssue]
        self.model = self.system.scene.mj_model
        self.place, self.turn = (slice(4, 6), slice(6, 7)) if is_planar else (slice(24, 27), slice(27, 30))
        self.start, self.angle = np.concatenate([start, np.zeros(self.model.nv)]), np.deg2rad(settings.angle)
        self.near = settings.position_tolerance, np.deg2rad(settings.angle_tolerance)
        change = jnp.zeros(2 * self.model.nv).at[self.turn.stop - 1].set(self.angle)
        self.goal = np.asarray(self.system.retract(jnp.asarray(self.start), change))

    def changes(self, hand: float, place: float, turn: float, rest: float) -> np.ndarray:
        """Return one number per coordinate of a change: of the hand, the body's place and turn, and velocities."""
        found = np.full(2 * self.model.nv, rest)
        found[: self.place.start], found[self.place], found[self.turn] = hand, place, turn
        return found

    def away(self, states: Any, start: Any) -> np.ndarray:
        """Return the changes of states from a start."""
        return np.asarray(jax.vmap(self.system.difference, (0, None))(states, start))

    def tree(self, arm: str, batch: int) -> Tree:
        """Return the planner of an arm."""
        upper, (place, turn) = self.changes(1.0, self.near[0], 3 * self.near[1], 0.0), self.near
        lower, upper[self.turn.stop - 1] = -upper, 3 * turn + self.angle
        return Tree(
            self.system, self.goal, self.changes(np.inf, place, turn, np.inf), lower=lower, upper=upper, reach=_REACH,
            resolution=self.changes(0.2, 0.02, 0.1, np.inf), batch=batch,
            smoother=Exact() if arm == UNSMOOTHED else Sampled(None, _STDDEV, 20 + len(self.control)),
        )  # fmt: skip

    def polished(self, controls: Any, key: jax.Array, count: int) -> np.ndarray:
        """Return controls after some iterations of trajectory optimisation."""
        weight = self.changes(0.0, self.near[0] ** -2, self.near[1] ** -2, 0.0)
        given = self.system, GoalCost(self.goal, 0.0, weight, 1e-3), self.start, controls, key
        return np.asarray(optimise_trajectory(*given, smoother=Exact(), schedule=np.ones(count)).controls)

    def replayed(self, controls: np.ndarray) -> np.ndarray:
        """Return the states at every time step of plain C MuJoCo under controls."""
        data, states = mujoco.MjData(self.model), [self.start]
        data.qpos[:] = self.start[: self.model.nq]
        for data.ctrl[:] in np.repeat(controls, self.system.num_substeps, axis=0):
            mujoco.mj_step(self.model, data)
            states.append(np.concatenate([data.qpos, data.qvel]))
        return np.array(states)


def _block() -> tuple[mujoco.MjModel, np.ndarray, np.ndarray]:
    """Return the Shadow hand with a block, controls that half curl its fingers, and the positions at rest."""
    from experiments.robots import fetched

    try:
        folder = fetched("gymnasium-robotics") / "gymnasium_robotics/envs/assets/hand"
    except (subprocess.CalledProcessError, OSError) as error:
        raise ExperimentError(f"the hand of gymnasium-robotics could not be downloaded: {error}") from error
    spec = mujoco.MjSpec.from_file(str(folder / "manipulate_block.xml"))
    spec.delete(spec.joint("target:joint"))  # the goal of gymnasium's own tasks is a free body that falls
    spec.body("target").pos = [1.09, 0.81, 0.2]
    spec.worldbody.add_camera(name="above", pos=[0.855, 0.649, 0.515], quat=[0.908, 0.331, -0.089, -0.243], fovy=37)
    data = mujoco.MjData(model := spec.compile())
    data.ctrl[:] = [0.5 * (model.actuator(i).name[-3:] in ("FJ2", "FJ1")) for i in range(model.nu)]
    mujoco.mj_step(model, data, 1500)
    return model, data.ctrl.copy(), data.qpos.copy()


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Search by every arm from every seed."""
    problem, parts = Problem(settings), {}
    trees = {arm: problem.tree(arm, settings.batch) for arm in (SMOOTHED, UNSMOOTHED)}
    for number, arm in itertools.product(range(settings.sizes.num_seeds), ARMS):
        given = problem, settings, trees.get(arm), arm, settings.seed + number
        parts[f"{arm} {settings.seed + number}"] = functools.partial(_attempt, *given)
    return Outcome(settings, workspace.each("search", "attempts", parts))


def _attempt(problem: Problem, settings: Settings, tree: Tree | None, arm: str, seed: int) -> Attempt:
    key, start, control, count = jax.random.key(seed), problem.start, problem.control, settings.num_iterations
    if tree is None:
        course, points, parents, seconds = np.array([np.inf]), np.zeros((1, 2)), np.array([-1]), 0.0
        noise = jax.random.normal(key, (_HORIZON, len(control)))
        controls = problem.polished(control + 0.1 * _STDDEV * noise, key, 2 * count)
    else:
        sizes = settings.sizes
        found = tree.search(start, control, key, capacity=sizes.capacity, max_seconds=sizes.max_seconds)
        course, parents, seconds = np.minimum.accumulate(found.errors), found.parents, found.seconds
        away = problem.away(found.nodes, start)
        turned, displaced = np.rad2deg(away[:, problem.turn.stop - 1]), np.linalg.norm(away[:, problem.place], axis=1)
        points = np.stack([displaced, turned], axis=1)
        controls = problem.polished(found.controls, key, count) if found.found else found.controls
    states = problem.replayed(controls)
    off = problem.away(states[-1:], problem.goal)[0]
    error = float(np.max(np.abs(off) / problem.changes(np.inf, *problem.near, np.inf)))
    angle = float(np.rad2deg(np.linalg.norm(off[problem.turn])))
    return Attempt(arm, seed, course, points, parents, states, error, angle, len(controls), seconds)


def answer(outcome: Outcome) -> str:
    """Count the seeds from which each arm turns the body."""
    counts = (f"{arm} {len(outcome.of(arm, solved=True))} of {len(outcome.of(arm))}" for arm in ARMS)
    return ", ".join(counts).capitalize() + "."


def verdict(outcome: Outcome) -> str:
    """Say how much each arm needed, and how exactly its paths end."""
    said = []
    for arm in ARMS:
        good = [(len(one.course), one.seconds, one.angle_error) for one in outcome.of(arm, solved=True)]
        nodes, seconds, angle = np.median(good, axis=0) if good else np.zeros(3)
        searched = f" after {nodes:.0f} nodes and {seconds:.1f} s" if arm != ALONE else ""
        told = f"{len(good)} of {len(outcome.of(arm))} seeds{searched} to {angle:.2g}° (medians)" if good else "no seed"
        said.append(f"{arm.capitalize()} turns the body from {told}.")
    return " ".join(said)


def findings(outcome: Outcome) -> list[str]:
    """Say what counts, and how far trajectory optimisation comes."""
    off = [one.angle_error for one in outcome.of(ALONE)]
    counts = "What counts is the replay of the controls by plain C MuJoCo"
    return [f"{counts}; trajectory optimisation alone ends {min(off):.0f} to {max(off):.0f}° from the goal."]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the attempts."""
    rows = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()] for row in outcome.rows()]
    columns = ("arm", "seed", "end from goal, in tolerances", "angle off, °", "steps", "search, s", "nodes")
    return [Table(columns, rows, "Every attempt; times are without compilation, and without polishing.")]


def drawings(outcome: Outcome) -> Drawings:
    """Draw the distance from the goal against nodes, and one tree."""
    picture, axes = subplots(1, 2, height=4.6)
    left, right = axes[0]
    for arm, colour in ((UNSMOOTHED, FIRST), (SMOOTHED, ZEROTH)):
        for label, one in zip([arm, *[None] * len(outcome.attempts)], outcome.of(arm), strict=False):
            left.plot(1 + np.arange(len(one.course)), one.course, color=colour, lw=1.2, label=label)
            left.plot(len(one.course), one.course[-1], "o" if one.course[-1] <= 1 else "x", color=colour, ms=5)
    left.set(title="Distance of the nearest node, in tolerances", xlabel="nodes", xscale="log", yscale="log")
    shown = _shown(outcome)
    x, y, line = 1e3 * shown.points[:, 0], shown.points[:, 1], [int(np.argmin(shown.course))]
    for child, parent in enumerate(shown.parents[1:], start=1):
        right.plot(x[[parent, child]], y[[parent, child]], color=MUTED, lw=0.5, alpha=0.6)
    while line[-1] > 0:
        line.append(int(shown.parents[line[-1]]))
    right.plot(x[line], y[line], ".-", color=ZEROTH, lw=2)
    right.plot(x[0], y[0], "s", color=REFERENCE, ms=6)
    for axis, level in ((left, 1.0), (right, outcome.settings.angle)):
        axis.axhline(level, color=MUTED, lw=1.0, ls=(0, (1, 2)))
    right.set(title="A tree and its path", xlabel="displacement of the body, mm", ylabel="turn, degrees")
    legend_below(picture, left, 2)
    caption = (
        "Left, one curve per seed; a dot is a goal that was reached, a cross one that was not. Right, the nodes of the "
        f"smoothed tree of seed {shown.seed}, and its path from the square to the goal before it is polished."
    )
    return {"tree": (picture, "How trees reach the goal", caption)}


def _shown(outcome: Outcome) -> Attempt:
    return (outcome.of(SMOOTHED, solved=True) or outcome.of(SMOOTHED))[0]


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the replay, with the goal beside it; return the file and its caption."""
    shown, problem = _shown(outcome), Problem(outcome.settings)
    model, target = copy.copy(problem.model), problem.model.body("target").id
    model.body_quat[target] = [np.cos(problem.angle / 2), 0, 0, np.sin(problem.angle / 2)]
    rest = np.repeat(shown.states[-1:], int(wanted.speed / model.opt.timestep), axis=0)
    motion = np.concatenate([shown.states, rest])[:, : model.nq]
    caption = f"The path of seed {shown.seed}, replayed by C MuJoCo, {shown_speed(wanted.speed)}; beside it the goal."
    return film(workspace, [(model, motion)], wanted, camera="above", caption=caption)
