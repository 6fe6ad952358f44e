"""mjxgrad on every point of a scene's grid: one compiled program per scene, precision and gradient."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.stability.reference import Course, unbalanced
from experiments.stability.scenes import StabilityScene
from mjxgrad._mjx import mjx
from mjxgrad._rollout import Observe, Trajectory
from mjxgrad.dynamics import Gradient


class Steps(eqx.Module):
    """What the solves of a rollout were given and found."""

    qpos: Float[np.ndarray, "points steps nq"]  # positions before each step
    qvel: Float[np.ndarray, "points steps nv"]  # velocities, likewise
    qacc: Float[np.ndarray, "points steps nv"]  # the acceleration found
    unbalanced: Float[np.ndarray, "points steps"]  # share of the forces that it leaves; 0 from the first bad step on


@dataclass(frozen=True)
class Run:
    """What mjxgrad did on every point."""

    course: Course  # the motion
    value: Float[np.ndarray, " points"]  # the outcome at the end
    # Of the outcome with respect to the model's fields, positions and velocities.
    gradient: tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]
    is_silent: np.ndarray  # whether a rollout returned a number that is not finite without a flag
    is_gradient_finite: np.ndarray  # whether all numbers of the gradient are
    is_unsolved: np.ndarray  # whether the rollout says that some step's forces are not in balance
    steps: Steps  # state and solution at each step, for a closer look at those that seem wrong


def _observe(model: mjx.Model, data: mjx.Data) -> tuple[Array, Array, Array, Array]:
    mass, forces = mjx.full_m(model, data), (data.qfrc_smooth, data.qfrc_constraint)
    kinetic = 0.5 * data.qvel @ mass @ data.qvel
    potential = -model.body_mass @ (data.xipos @ model.opt.gravity)
    return kinetic, potential, unbalanced(mass, data.qacc, data.qvel, *forces, model.opt.timestep), data.qacc


class Program:
    """A scene's rollout with its gradient, vectorised over points, a chunk at once."""

    def __init__(
        self, scene: StabilityScene, num_steps: int, gradient: Gradient, chunk: int, onset: mg.Onset | None = None
    ):
        self._scene = mg.load_scene(scene.model())
        self._weights = jnp.array(scene.outcome)
        self._gradient: Gradient = gradient
        self._onset = onset
        self._num_steps, self._chunk = num_steps, chunk
        both = jax.value_and_grad(self._outcome, argnums=(0, 1, 2), has_aux=True)
        self._both = jax.jit(jax.vmap(both))
        # Finite differences need no gradient, which takes four times as long as its value.
        self._value = jax.jit(jax.vmap(lambda *start: self._outcome(*start, observe=None)[0]))

    def values(self, fields: dict[str, np.ndarray], qpos: np.ndarray, qvel: np.ndarray) -> Float[np.ndarray, " points"]:
        """Give the outcome alone, from the model's fields and the start of every point."""
        return np.concatenate(
            [np.asarray(self._value(*arrays))[:count] for count, arrays in self._chunks((fields, qpos, qvel))]
        )

    def run(self, fields: dict[str, np.ndarray], qpos: np.ndarray, qvel: np.ndarray) -> Run:
        """Simulate and differentiate, likewise."""
        parts = []
        for count, arrays in self._chunks((fields, qpos, qvel)):
            (value, trajectory), gradient = self._both(*arrays)
            parts.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], (value, trajectory, gradient)))
        value, trajectory, gradient = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        kinetic, potential, residual, qacc = trajectory.observations
        # From the first bad step on the solver is asked what has no answer.
        first_bad, step = trajectory.first_bad_step, np.arange(residual.shape[1])
        residual = np.where((first_bad[:, None] >= 0) & (step >= first_bad[:, None]), 0.0, residual)
        is_silent = ~trajectory.diverged & ~_all_finite((trajectory, value))
        ends = trajectory.qpos[:, -1], trajectory.qvel[:, -1]
        course = Course(*ends, kinetic, potential, residual.max(axis=1), first_bad)
        last = self._num_steps
        steps = Steps(trajectory.qpos[:, :last], trajectory.qvel[:, :last], qacc[:, :last], residual[:, :last])
        return Run(course, value, gradient, is_silent, _all_finite(gradient), trajectory.unsolved > 0, steps)

    def _outcome(
        self, fields: dict[str, Array], qpos: Array, qvel: Array, observe: Observe | None = _observe
    ) -> tuple[Array, Trajectory]:
        scene = _with_fields(self._scene, fields)
        state = mg.initial_state(scene, qpos, qvel)
        trajectory = mg.rollout(
            scene, state, horizon=self._num_steps, observe=observe, gradient=self._gradient, onset=self._onset
        )
        return trajectory.qpos[-1] @ self._weights, trajectory

    def _chunks(self, arrays) -> Iterator[tuple[int, Any]]:
        return _chunks(arrays, self._chunk, self._scene.data.qpos.dtype)


def errors_of_solves(
    scene: StabilityScene, fields: dict[str, np.ndarray], steps: Steps, chunk: int
) -> Float[np.ndarray, "points steps"]:
    """Ask the forces of a solve of the same states, in the present precision, whether they balance accelerations found.

    Forces out of balance bound the error of an acceleration, but in single precision those of stiff rows may be out of balance
    by rounding alone, with hardly an error. The answer is the share of a step's velocity by which each is off.
    """
    loaded = mg.load_scene(scene.model())

    def error(fields: dict[str, Array], qpos: Array, qvel: Array, qacc: Array) -> Array:
        model = _with_fields(loaded, fields).model
        data = mg.forward(model, loaded.data.replace(qpos=qpos, qvel=qvel))
        forces = (data.qfrc_smooth, data.qfrc_constraint)
        return unbalanced(mjx.full_m(model, data), qacc, qvel, *forces, model.opt.timestep)

    run = jax.jit(jax.vmap(jax.vmap(error, in_axes=(None, 0, 0, 0))))
    at_once = max(1, chunk // steps.qpos.shape[1])
    pieces = _chunks((fields, steps.qpos, steps.qvel, steps.qacc), at_once, loaded.data.qpos.dtype)
    return np.concatenate([np.asarray(run(*arrays))[:count] for count, arrays in pieces])


def _with_fields(scene: mg.Scene, fields: dict[str, Array]) -> mg.Scene:
    others = {name: value for name, value in fields.items() if name != "timestep"}
    model = scene.model.replace(**others).tree_replace({"opt.timestep": fields["timestep"]})
    return eqx.tree_at(lambda scene: scene.model, scene, model)


def _chunks(arrays: Any, size: int, dtype: Any) -> Iterator[tuple[int, Any]]:
    """Cut into pieces of one length, the last filled up with its last point."""
    total = len(arrays[1])
    for start in range(0, total, size):
        index = np.minimum(np.arange(start, start + size), total - 1)
        yield min(size, total - start), jax.tree.map(lambda x, i=index: x[i].astype(dtype), arrays)


def along(run: Run, changes: dict[str, np.ndarray]) -> Float[np.ndarray, " points"]:
    """Take a gradient along a change of fields, and of the start, "qpos" and "qvel"."""
    fields, qpos, qvel = run.gradient
    parts = {**fields, "qpos": qpos, "qvel": qvel}
    with np.errstate(all="ignore"):
        terms = [(parts[name] * change).reshape(len(qpos), -1).sum(axis=1) for name, change in changes.items()]
    return np.sum(terms, axis=0)


def _all_finite(tree: Any) -> np.ndarray:
    leaves = [x for x in jax.tree.leaves(tree) if np.issubdtype(np.asarray(x).dtype, np.floating)]
    return np.all([np.isfinite(x).reshape(len(x), -1).all(axis=1) for x in leaves], axis=0)
