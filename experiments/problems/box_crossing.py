"""A robot on three wheels crosses a box in 6 s along a recorded path; its wheel speeds are splines of 10 knots.

The loss is the mean squared distance of the hull from the path, seen from above. Scene, spline, starts and loss are published
(github.com/aleskucera/ostrich, experiments/3_gradient_quality_box/RESULTS.md, May 2026). The recording is not: the path is read
off a replay, 9 cm from it in the root mean square (run 18_10_33 of 1_sim_to_real_box/results/sweep_mujoco.json).
"""

import functools
import time
from collections import namedtuple
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from jaxtyping import Array, Float

import mjxgrad as mg
from mjxgrad.estimators.estimate import Diagnosis, GradientEstimate, Reason
from mjxgrad.objective.task import InScene
from mjxgrad.stepping import EngineName, own_motion
from mjxgrad.tasks import scene_path

DURATION, KNOTS, WHEELS = 6.0, 10, 3
PATH = np.array([[0.03, 0.10, 0.18, 0.33, 0.48, 0.62, 0.74, 0.82, 1.06, 1.36, 1.67, 1.86, 2.01],
                 [0.00, 0.00, 0.00, 0.01, 0.01, 0.02, 0.02, 0.02, 0.02, 0.01, 0.01, 0.02, 0.02]])  # fmt: skip
# Seconds without compilation on an RTX 3090, and the loss then (m²).
PUBLISHED = {"Ostrich": (10.0, 0.074), "MJX": (900.0, 0.30), "Newton, semi-implicit": (1400.0, 1.25)}

# When (s, without compilation) which loss (m²) was known, with the norm of the estimated gradient; the knots of least loss.
Descent = namedtuple("Descent", "seconds loss gradient_norm params compile_seconds")


class BoxCrossing(InScene):
    """The crossing: where the hull should be after each step (m), and from knots to wheel speeds, linear in between."""

    target: Float[Array, "steps 2"]
    spline: Float[Array, "steps knots"]

    def start(self, seed: int = 42) -> Float[Array, " dim"]:
        """Return random knots about 2 rad/s by NumPy's numbers; 42, 43 and 44 are published."""
        return jnp.asarray(2 + 0.5 * np.random.default_rng(seed).standard_normal(KNOTS * WHEELS), self.target.dtype)

    def trajectory(self, params: Float[Array, " dim"]) -> mg.Trajectory:
        speeds = self.spline @ params.reshape(KNOTS, WHEELS)
        return mg.rollout(self.scene, mg.initial_state(self.scene), speeds, contact=self.contact)

    def residuals(self, params: Float[Array, " dim"]) -> Float[Array, " twice_steps"]:
        """Return numbers whose squares add up to the loss, in m; NaN if the rollout diverged."""
        trajectory = self.trajectory(params)
        away = (trajectory.qpos[1:, :2] - self.target) / np.sqrt(len(self.target))
        return jnp.where(trajectory.diverged, jnp.nan, away).ravel()

    def loss(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Return the mean squared distance from the path, in m²."""
        return jnp.sum(self.residuals(params) ** 2)


def box_crossing(
    wheels: str = "cylinder", engine: EngineName = "mujoco", gradient: str = "discrete", ccd_tolerance: float = 1e-14
) -> BoxCrossing:
    """Load the crossing on cylinders, or on capsules for MJX; the tolerance (m) is of the search for contacts of cylinders."""
    spec = mujoco.MjSpec.from_file(str(scene_path("box_crossing")))
    for name in ("left", "right", "rear"):
        spec.geom(name).type = getattr(mujoco.mjtGeom, f"mjGEOM_{wheels.upper()}")
    spec.option.ccd_tolerance = ccd_tolerance
    scene = mg.load_scene(spec.compile()).with_engine(engine)
    count = round(DURATION / scene.mj_model.opt.timestep)
    times = np.linspace(0, PATH.shape[1] - 1, count + 1)[1:]
    target = np.stack([np.interp(times, np.arange(PATH.shape[1]), along) for along in PATH], axis=1)
    spline = jnp.maximum(1 - jnp.abs(jnp.linspace(0, KNOTS - 1, count)[:, None] - jnp.arange(KNOTS)), 0)
    return BoxCrossing(scene, jnp.asarray(target), spline, contact=own_motion(gradient))


def descend(task: BoxCrossing, method: str, num_steps: int, seed: int = 42, num_samples: int = 1, stddev: float = 0.1,
            learning_rate: float = 0.3) -> Descent:  # fmt: skip
    """Descend from a start by "least_squares", "cross_entropy", or an estimator and Adam, whose rate falls to a fifth.

    The noise is on knots (rad/s); first order of one sample takes none. Gradients are clipped at norm 1, as published.
    """
    start, key = task.start(seed), jax.random.key(seed)
    if method == "least_squares":
        return _least_squares(task, start, num_steps)
    objective, is_exact = mg.parameter_noise(task.loss, stddev, dim=start.size), num_samples == 1
    options: dict[str, Any] = {"num_steps": num_steps}
    options |= {} if is_exact else {"evaluate": task.loss, "evaluate_every": 1}
    if method == "cross_entropy":
        options |= {"num_samples": num_samples, "num_elite": max(2, num_samples // 5)}
        found = mg.baselines.cross_entropy(objective, start, key, **options)
    else:
        estimator = _exact if is_exact else functools.partial(getattr(mg.estimators, method), num_samples=num_samples)
        rate = optax.cosine_decay_schedule(learning_rate, num_steps, 0.2)
        optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
        found = mg.optimise(objective, start, key, estimator=estimator, optimiser=optimiser, **options)
    course, best = found.history, np.asarray(found.best_params)
    loss = course.cost if is_exact else course.noise_free_cost
    return Descent(course.seconds, loss, course.gradient_norm, best, found.compile_seconds)


def _exact(objective: mg.Objective, params: Float[Array, " dim"], key: Array) -> GradientEstimate:
    """Return the gradient without noise."""
    cost, slope = jax.value_and_grad(objective.value)(params, jnp.zeros_like(params))
    none, zero, one, fine = 0 * slope, 0 * cost, jnp.asarray(1), Diagnosis.fine
    return GradientEstimate(slope, none, none, cost, zero, one, one, one, one, fine, zero + 1, Reason.fixed, zero)


def _least_squares(task: BoxCrossing, start: Float[Array, " dim"], num_steps: int) -> Descent:
    """Take steps of Levenberg and Marquardt, with derivatives of all residuals in forward mode."""
    began, residuals = time.perf_counter(), lambda params: task.residuals(params)
    values, slopes = (jax.jit(f).lower(start).compile() for f in (residuals, jax.jacfwd(residuals)))
    compiled, rows, began = time.perf_counter() - began, [], time.perf_counter()
    params, away, slope, damping, is_better = np.asarray(start), np.asarray(values(start)), np.zeros(0), 0.01, True
    for _ in range(num_steps):
        if is_better:
            slope = np.asarray(slopes(params))
            rows.append((time.perf_counter() - began, away @ away, 2 * np.linalg.norm(slope.T @ away)))
        tried = params - np.linalg.solve(slope.T @ slope + damping * np.eye(len(params)), slope.T @ away)
        found = np.asarray(values(tried))
        is_better = found @ found < away @ away  # not if it is NaN
        params, away, damping = (tried, found, damping / 3) if is_better else (params, away, 5 * damping)
        rows.append((time.perf_counter() - began, away @ away, np.nan))
    seconds, loss, norm = np.array(rows).T
    return Descent(seconds, loss, norm, params, compiled)
