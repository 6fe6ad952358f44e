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
from mjxgrad.dynamics import Gradient
from mjxgrad.rollout import Observe, Trajectory


@dataclass(frozen=True)
class Run:
    """What mjxgrad did on every point.

    Attributes:
        course: the motion.
        value: the outcome at the end.
        gradient: of the outcome with respect to the model's fields, positions and velocities.
        is_silent: whether a rollout returned a number that is not finite without a flag.
        is_gradient_finite: whether all numbers of the gradient are.
        is_unsolved: whether the rollout says that some step's forces are not in balance.
    """

    course: Course
    value: Float[np.ndarray, " points"]
    gradient: tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]
    is_silent: np.ndarray
    is_gradient_finite: np.ndarray
    is_unsolved: np.ndarray


def _observe(model: mjx.Model, data: mjx.Data) -> tuple[Array, Array, Array]:
    mass, forces = mjx.full_m(model, data), (data.qfrc_smooth, data.qfrc_constraint)
    kinetic = 0.5 * data.qvel @ mass @ data.qvel
    potential = -model.body_mass @ (data.xipos @ model.opt.gravity)
    return kinetic, potential, unbalanced(mass, data.qacc, data.qvel, *forces, model.opt.timestep)


class Program:
    """A scene's rollout with its gradient, vectorised over points.

    Args:
        scene: of the catalogue.
        num_steps: of the rollout.
        gradient: "discrete" or "event".
        chunk: points at once.
    """

    def __init__(self, scene: StabilityScene, num_steps: int, gradient: Gradient, chunk: int):
        self._scene = mg.load_scene(scene.model())
        self._weights = jnp.array(scene.outcome)
        self._gradient: Gradient = gradient
        self._num_steps, self._chunk = num_steps, chunk
        both = jax.value_and_grad(self._outcome, argnums=(0, 1, 2), has_aux=True)
        self._both = jax.jit(jax.vmap(both))
        # Finite differences need no gradient, which takes four times as long as its value.
        self._value = jax.jit(jax.vmap(lambda *start: self._outcome(*start, observe=None)[0]))

    def values(self, fields: dict[str, np.ndarray], qpos: np.ndarray, qvel: np.ndarray) -> Float[np.ndarray, " points"]:
        """Give the outcome alone.

        Args:
            fields: of the model, for every point.
            qpos: where each rollout starts.
            qvel: likewise.
        """
        parts = [np.asarray(self._value(*arrays))[:count] for count, arrays in self._chunks((fields, qpos, qvel))]
        return np.concatenate(parts)

    def run(self, fields: dict[str, np.ndarray], qpos: np.ndarray, qvel: np.ndarray) -> Run:
        """Simulate and differentiate.

        Args:
            fields: of the model, for every point.
            qpos: where each rollout starts.
            qvel: likewise.

        Returns:
            What came out.
        """
        parts = []
        for count, arrays in self._chunks((fields, qpos, qvel)):
            (value, trajectory), gradient = self._both(*arrays)
            parts.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], (value, trajectory, gradient)))
        value, trajectory, gradient = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        kinetic, potential, residual = trajectory.observations
        is_silent = ~trajectory.diverged & ~_all_finite((trajectory, value))
        course = Course(
            trajectory.qpos[:, -1],
            trajectory.qvel[:, -1],
            kinetic,
            potential,
            # From the first bad step on the solver is asked what has no answer.
            _until(residual, trajectory.first_bad_step).max(axis=1),
            trajectory.first_bad_step,
        )
        return Run(course, value, gradient, is_silent, _all_finite(gradient), trajectory.unsolved > 0)

    def _outcome(
        self, fields: dict[str, Array], qpos: Array, qvel: Array, observe: Observe | None = _observe
    ) -> tuple[Array, Trajectory]:
        others = {name: value for name, value in fields.items() if name != "timestep"}
        model = self._scene.model.replace(**others).tree_replace({"opt.timestep": fields["timestep"]})
        scene = eqx.tree_at(lambda scene: scene.model, self._scene, model)
        state = mg.initial_state(scene, qpos, qvel)
        trajectory = mg.rollout(scene, state, horizon=self._num_steps, observe=observe, gradient=self._gradient)
        return trajectory.qpos[-1] @ self._weights, trajectory

    def _chunks(self, arrays) -> Iterator[tuple[int, Any]]:
        """Cut into pieces of one length, the last filled up with its last point."""
        total = len(arrays[1])
        dtype = self._scene.data.qpos.dtype
        for start in range(0, total, self._chunk):
            index = np.minimum(np.arange(start, start + self._chunk), total - 1)
            yield min(self._chunk, total - start), jax.tree.map(lambda x, i=index: x[i].astype(dtype), arrays)


def along(run: Run, changes: dict[str, np.ndarray]) -> Float[np.ndarray, " points"]:
    """Take a gradient along a change of fields, positions and velocities.

    Args:
        run: of all points.
        changes: by field; "qpos" and "qvel" are the start.
    """
    fields, qpos, qvel = run.gradient
    parts = {**fields, "qpos": qpos, "qvel": qvel}
    with np.errstate(all="ignore"):
        terms = [(parts[name] * change).reshape(len(qpos), -1).sum(axis=1) for name, change in changes.items()]
    return np.sum(terms, axis=0)


def _all_finite(tree: Any) -> np.ndarray:
    leaves = [x for x in jax.tree.leaves(tree) if np.issubdtype(np.asarray(x).dtype, np.floating)]
    return np.all([np.isfinite(x).reshape(len(x), -1).all(axis=1) for x in leaves], axis=0)


def _until(values: Float[np.ndarray, "points states"], first_bad: np.ndarray) -> Float[np.ndarray, "points states"]:
    step = np.arange(values.shape[1])
    return np.where((first_bad[:, None] >= 0) & (step >= first_bad[:, None]), 0.0, values)
