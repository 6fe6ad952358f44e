"""From settings to numbers."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.billiards import hard
from experiments.billiards.settings import MethodSettings, Settings
from experiments.workspace import Workspace
from mjxgrad.dynamics import Smoothing
from mjxgrad.tasks.billiards import Billiards, billiards

IDLE = 2.0  # m², the cost of standing still
_LEARNING_RATE = 0.1  # of Adam, in N; it falls along a cosine to a twentieth
_FINAL_SCALE = 0.02  # left at the last step of noise, margin or length; margin and length are then taken away
_EVALUATIONS = 20  # how often along a descent the true cost is measured


@dataclasses.dataclass(frozen=True)
class Run:
    """One descent; its costs are in m², without noise and with the contact as it is."""

    method: MethodSettings
    steps: np.ndarray  # at which the cost was measured
    cost: np.ndarray
    final_cost: float  # of the best forces that were measured
    hard_cost: float  # of the same forces with balls that collide in no time, by another program
    qpos: np.ndarray  # (states, 4) of the stroke with these forces
    touches_at_start: bool
    num_rollouts: int
    seconds: float
    compile_seconds: float

    @property
    def is_solved(self) -> bool:
        """Whether hard balls, too, are within one per cent of the best."""
        return max(self.final_cost, self.hard_cost) < 1.01 * hard.optimum()[0]

    @property
    def is_stuck(self) -> bool:
        """Whether it ends within one per cent of standing still, or above."""
        return self.final_cost > 0.99 * IDLE


@dataclasses.dataclass(frozen=True)
class Outcome:
    """All numbers."""

    settings: Settings
    runs: tuple[Run, ...]  # one per method

    def rows(self) -> list[dict[str, Any]]:
        """Give the cost along each descent, for metrics.csv."""
        columns = ("final_cost", "hard_cost", "touches_at_start", "num_rollouts", "seconds", "compile_seconds")
        return [
            {"method": run.method.label, "step": int(step), "cost": float(cost)}
            | {name: getattr(run, name) for name in columns}
            for run in self.runs
            for step, cost in zip(run.steps, run.cost, strict=True)
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend by every method."""
    task = billiards()
    workspace.check(task.scene)
    play = jax.jit(lambda params: task.trajectory(params).qpos)
    runs = []
    with workspace.stage("descents", "methods", len(settings.methods)) as advance_to:
        for i, method in enumerate(settings.methods):
            key = jax.random.fold_in(jax.random.key(settings.seed), i)
            runs.append(_run(method, task, settings, key, play))
            advance_to(len(runs))
    return Outcome(settings, tuple(runs))


def _run(
    method: MethodSettings, task: Billiards, settings: Settings, key: Array, play: Callable[[Array], Array]
) -> Run:
    every = -(-settings.num_steps // _EVALUATIONS)
    start = task.start(method.start)
    rate = optax.cosine_decay_schedule(_LEARNING_RATE, settings.num_steps, 0.05)
    decay = optax.exponential_decay(1.0, settings.num_steps, _FINAL_SCALE)
    result = mg.optimise(
        _objective(method, task.with_gradient(method.gradient), settings),
        start,
        key,
        estimator=functools.partial(getattr(mg.estimators, method.estimator), num_samples=method.num_samples),
        optimiser=optax.adam(rate),
        num_steps=settings.num_steps,
        annealing=decay,
        evaluate=task.cost,
        evaluate_every=every,
    )
    # Where nothing is felt the descent stops early.
    done = int(result.num_steps)
    steps = np.arange(0, done, every)
    return Run(
        method=method,
        steps=np.append(steps, done),
        cost=np.append(np.asarray(result.history.noise_free_cost)[steps], result.final_cost),
        final_cost=float(result.best_cost),
        hard_cost=hard.cost(np.asarray(result.best_params).reshape(-1, 2)),
        qpos=np.asarray(play(result.best_params)),
        touches_at_start=bool(np.any(np.asarray(play(start))[-1, 2:] != 0)),
        num_rollouts=int(result.num_rollouts),
        seconds=result.seconds,
        compile_seconds=result.compile_seconds,
    )


def _objective(
    method: MethodSettings, task: Billiards, settings: Settings
) -> Callable[[Float[Array, ""]], mg.Objective]:
    """From the scale of the smoothing to what is minimised at it."""
    own = task.scene.model.pair_margin[0]
    # In the last tenth of the steps the contact is as it is.
    last = _FINAL_SCALE**0.9

    def objective(scale: Float[Array, ""]) -> mg.Objective:
        smoothed = task
        if method.margin is not None:
            smoothed = task.with_margin(own + jnp.where(scale > last, method.margin * scale, 0.0))
        if method.length is not None:
            smoothed = task.with_smoothing(Smoothing(jnp.maximum(method.length * scale, 1e-6)))
        return smoothed.objective(method.stddev).with_stddev(method.stddev * scale)

    return objective
