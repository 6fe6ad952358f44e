"""From settings to plans, and what follows from them."""

import time
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import mjxgrad as mg
from experiments.planning.settings import NAMES, Settings
from experiments.planning.tree import Sampling, path, search
from experiments.problems.planar_pusher import PlanarPusher, beside_rod, planar_pusher
from experiments.workspace import Workspace
from mjxgrad.planning import GoalCost, Plan, Smoother, optimise_trajectory
from mjxgrad.stepping import Smoothing


@dataclass(frozen=True)
class Attempt:
    """One way of planning."""

    model: str  # which linear models it used
    seed: int  # of its random numbers
    seconds: float  # wall time, compilation included where it was the first of its kind
    states: Float[np.ndarray, "states state"]  # that the system goes through under the controls that it found
    controls: Float[np.ndarray, "horizon 2"]  # finger speeds
    course: dict[str, Float[np.ndarray, " count"]]  # numbers by name along its iterations or nodes
    nodes: Float[np.ndarray, "nodes state"] | None = None  # the states of a tree, none for a trajectory
    parents: Int[np.ndarray, " nodes"] | None = None  # of these nodes

    @property
    def label(self) -> str:
        """Give a name for legends."""
        return NAMES[self.model]


@dataclass(frozen=True)
class Outcome:
    """All that was found."""

    settings: Settings  # of the run
    attempts: list[Attempt]  # in the order of the settings, seeds last
    # The shortest way of the first kind after trajectory optimisation, if it was asked for and there is one.
    polished: Attempt | None
    shown: Float[np.ndarray, "steps 5"]  # positions of the best plan at every time step, from a rollout of its own
    timestep: float  # between these (s)

    @property
    def goal(self) -> Float[np.ndarray, " 3"]:
        """Where the rod is to be."""
        return np.asarray(self.settings.goal)

    def distance(self, attempt: Attempt) -> float:
        """Give the distance of the rod from its goal in the end (m)."""
        return float(np.hypot(*(attempt.states[-1, 2:4] - self.goal[:2])))

    def angle(self, attempt: Attempt) -> float:
        """Give the angle between the rod and its goal in the end (rad)."""
        return float(abs(attempt.states[-1, 4] - self.goal[2]))

    def _off(self, state: np.ndarray) -> float:
        """Give how far the coordinate of the rod that is farthest off is from the goal, in tolerances."""
        tree = self.settings.tree
        units = np.array([tree.position_tolerance, tree.position_tolerance, tree.angle_tolerance])
        return float(np.max(np.abs(state[2:5] - self.goal) / units))

    def is_solved(self, attempt: Attempt) -> bool:
        """Say whether the rod is at its goal, as near as the settings ask for."""
        return self._off(attempt.states[-1]) <= 1

    def moved(self, attempt: Attempt) -> float:
        """Give which share of the way to the goal was made good, in units of the tolerances."""
        return 1 - self._off(attempt.states[-1]) / self._off(attempt.states[0])

    def of(self, model: str) -> list[Attempt]:
        """Give all attempts with one kind of linear model."""
        return [attempt for attempt in self.attempts if attempt.model == model]

    @property
    def best(self) -> Attempt:
        """Give what figures and video show: the polished way, else the shortest solved one of the first kind."""
        return self.polished or self.shortest(self.settings.models[0])

    def shortest(self, model: str) -> Attempt:
        """Give the solved attempt of fewest steps, or the one that came nearest."""
        attempts = self.of(model)
        solved = [attempt for attempt in attempts if self.is_solved(attempt)]
        return min(solved, key=lambda one: len(one.controls)) if solved else max(attempts, key=self.moved)

    def rows(self) -> list[dict[str, Any]]:
        """Give one row per attempt for the table of metrics."""
        named = [("", attempt) for attempt in self.attempts] + ([(" polished", self.polished)] if self.polished else [])
        return [
            {
                "model": attempt.model + suffix,
                "seed": attempt.seed,
                "is_solved": self.is_solved(attempt),
                "distance_m": self.distance(attempt),
                "angle_rad": self.angle(attempt),
                "num_steps": len(attempt.controls),
                "num_nodes": 0 if attempt.nodes is None else len(attempt.nodes),
                "final_cost": float(attempt.course["cost"].min()) if "cost" in attempt.course else float("nan"),
                "seconds": attempt.seconds,
            }
            for suffix, attempt in named
        ]


# Weights of the rod's x, y and turn; a turn of 0.17 rad counts as much as 0.03 m.
_ROD = (0.0, 0.0, 1.0, 1.0, 0.03, 0.0, 0.0, 0.0, 0.0, 0.0)
_STAGE, _TERMINAL = 0.3, 100.0
_CONTROL = 0.02  # of the squared finger speed
# Where the tree samples, around the start (m, rad): the rod's pose, and the finger where `beside_rod` does not say.
_RANGE = (0.3, 0.3, 0.25, 0.25, 3.3)
# Displacements below which it does not matter that no control causes them (m, rad).
_RESOLUTION = (0.007, 0.007, 0.007, 0.007, 0.07)
_MAX_TURNS = 800  # of 16 samples
_POLISH_LENGTH = 0.002  # m, of the smoothing at which the optimisation of a way begins


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Plan in every way that is asked for."""
    task = planar_pusher(finger=settings.finger, goal=settings.goal)
    workspace.check(task.system.scene)
    attempts, polished = [], None
    num_seeds = settings.tree.num_seeds if settings.method == "tree" else 1
    with workspace.stage("planning", "attempts", len(settings.models) * num_seeds) as advance_to:
        for model in settings.models:
            run = _tree(task, settings, model) if settings.method == "tree" else _trajectory(task, settings, model)
            for seed in range(num_seeds):
                attempts.append(workspace.once(f"{model} {seed}", lambda run=run, seed=seed: run(seed)))
                advance_to(len(attempts))
    found = Outcome(settings, attempts, None, np.zeros((1, 5)), 0.0)
    if settings.method == "tree" and settings.tree.polish_iterations:
        shortest = found.shortest(settings.models[0])
        if found.is_solved(shortest):
            with workspace.stage("polishing", "ways", 1) as advance_to:
                polished = workspace.once("polished", lambda: _polish(task, settings, shortest))
                advance_to(1)
    best = polished or found.best
    with workspace.stage("rollout", "rollouts", 1):
        shown, timestep = _shown(task, best)
    return Outcome(settings, attempts, polished, shown, timestep)


def _smoother(model: str, settings: Settings, length: float) -> Smoother:
    """Give the linear models; sampled ones have noise of the same length on positions, less on velocities."""
    if model == "none":
        return mg.planning.Exact()
    if model == "analytic":
        return mg.planning.Analytic(Smoothing(length))
    rod_turn = length / 0.1  # as far at the rod's end
    state = jnp.array([length] * 4 + [rod_turn] + [0.1 * length] * 5)
    return mg.planning.Sampled(state, length, settings.num_samples, "first" if model == "mean_jacobian" else "zeroth")


def _trajectory(task: PlanarPusher, settings: Settings, model: str):
    """Give the function that optimises a trajectory from resting controls."""
    count = settings.num_iterations
    last = settings.last_length / settings.length
    schedule = np.concatenate([np.ones(count // 6), np.geomspace(1, last, count - 2 * (count // 6))])
    schedule = np.append(schedule, np.full(count // 6, last))

    def run(seed: int) -> Attempt:
        return _attempt(task, settings, model, jnp.zeros((settings.horizon, 2)), settings.length, schedule, seed)

    return run


def _polish(task: PlanarPusher, settings: Settings, way: Attempt) -> Attempt:
    """Optimise a way that was found."""
    schedule = np.geomspace(1, min(1, settings.last_length / _POLISH_LENGTH), settings.tree.polish_iterations)
    return _attempt(task, settings, way.model, jnp.asarray(way.controls), _POLISH_LENGTH, schedule, way.seed)


@eqx.filter_jit
def _optimised(
    task: PlanarPusher, settings: Settings, controls: jax.Array, smoother: Smoother, schedule: np.ndarray, seed: int
) -> Plan:
    limit, weight = task.speed_limit, jnp.array(_ROD)
    return optimise_trajectory(
        task.system,
        GoalCost(task.goal, _STAGE * weight, _TERMINAL * weight, _CONTROL),
        task.start,
        controls,
        jax.random.key(settings.seed + seed),
        smoother=smoother,
        schedule=schedule,
        lower=-limit,
        upper=limit,
    )


def _attempt(
    task: PlanarPusher, settings: Settings, model: str, start: jax.Array, length: float, factors: np.ndarray, seed: int
) -> Attempt:
    begin = time.perf_counter()
    plan = _optimised(task, settings, start, _smoother(model, settings, length), factors, seed)
    seconds, rows = time.perf_counter() - begin, plan.iterations
    course = {
        "length": length * np.asarray(rows.factor),
        "smoothed_cost": np.asarray(rows.smoothed_cost),
        "cost": np.append(plan.start_cost, rows.cost),
        "step": np.asarray(rows.step),
    }
    return Attempt(model, seed, seconds, np.asarray(plan.states), np.asarray(plan.controls), course)


def _tree(task: PlanarPusher, settings: Settings, model: str):
    """Give the function that grows a tree from a seed; all seeds share one program."""
    tree, width = settings.tree, jnp.array(_RANGE)
    free = [np.inf] * 2
    tolerance = np.array([*free, *[tree.position_tolerance] * 2, tree.angle_tolerance, *[np.inf] * 5])
    sampling = Sampling(-width, width, jnp.array(_RESOLUTION), transit=beside_rod)

    @eqx.filter_jit
    def grow(key):
        return search(
            task.system,
            task.start,
            task.goal,
            tolerance,
            key,
            smoother=_smoother(model, settings, settings.length),
            sampling=sampling,
            lower=-task.speed_limit,
            upper=task.speed_limit,
            capacity=tree.capacity,
            max_turns=_MAX_TURNS,
        )

    def run(seed: int) -> Attempt:
        begin = time.perf_counter()
        found = jax.block_until_ready(grow(jax.random.fold_in(jax.random.key(settings.seed), seed)))
        seconds, way, size = time.perf_counter() - begin, path(found), int(found.nodes.size)
        course = {"error": np.minimum.accumulate(np.asarray(found.nodes.errors)[:size])}
        nodes, parents = np.asarray(found.nodes.states)[:size], np.asarray(found.nodes.parents)[:size]
        return Attempt(model, seed, seconds, way.states, way.controls, course, nodes, parents)

    return run


def _shown(task: PlanarPusher, attempt: Attempt) -> tuple[np.ndarray, float]:
    """Roll the scene itself out under the controls of a plan, every time step kept."""
    system = task.system
    state = mg.initial_state(system.scene, qpos=system.positions(task.start))
    controls = jnp.repeat(jnp.asarray(attempt.controls), system.num_substeps, axis=0)
    trajectory = eqx.filter_jit(mg.rollout)(system.scene, state, controls)
    return np.asarray(trajectory.qpos), float(system.scene.model.opt.timestep)
