"""From settings to numbers."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.billiards import hard
from experiments.billiards.outcome import Outcome, Run
from experiments.billiards.settings import MethodSettings, Settings
from experiments.workspace import Workspace
from mjxgrad.dynamics import Smoothing
from mjxgrad.tasks.billiards import Billiards, billiards


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend by every method."""
    task = billiards(num_pieces=settings.num_pieces)
    workspace.check(task.scene)
    play = jax.jit(lambda params: task.trajectory(params).qpos)
    runs = []
    with workspace.stage("descents", "methods", len(settings.methods)) as advance_to:
        for i, method in enumerate(settings.methods):
            key = jax.random.fold_in(jax.random.key(settings.seed), i)
            runs.append(_run(method, task, settings, key, play))
            advance_to(len(runs))
    return Outcome(settings, hard.optimum(), tuple(runs), float(task.scene.mj_model.opt.timestep))


def _run(
    method: MethodSettings, task: Billiards, settings: Settings, key: Array, play: Callable[[Array], Array]
) -> Run:
    every = -(-settings.num_steps // settings.evaluations)
    start = task.start(method.start)
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.num_steps, 0.05)
    decay = optax.exponential_decay(1.0, settings.num_steps, settings.final_scale)
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
    forces = np.asarray(result.best_params).reshape(-1, 2)
    return Run(
        method=method,
        steps=np.append(steps, done),
        cost=np.append(np.asarray(result.history.noise_free_cost)[steps], result.final_cost),
        final_cost=float(result.best_cost),
        hard_cost=hard.cost(forces),
        forces=forces,
        qpos=np.asarray(play(result.best_params)),
        has_touched=bool(np.any(np.asarray(play(start))[-1, 2:] != 0)),
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
    last = settings.final_scale**0.9

    def objective(scale: Float[Array, ""]) -> mg.Objective:
        smoothed = task
        if method.margin is not None:
            smoothed = task.with_margin(own + jnp.where(scale > last, method.margin * scale, 0.0))
        if method.length is not None:
            smoothed = task.with_smoothing(Smoothing(jnp.maximum(method.length * scale, 1e-6)))
        noise = smoothed.objective(method.stddev)
        return noise.with_stddev(method.stddev * scale)

    return objective
