"""What an objective needs of a thing to be controlled: how long, how many controls, a cost."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad.rollout import State, Trajectory, rollout
from mjxgrad.scene import Scene

Policy = Callable[[PyTree, Any], Float[Array, " nu"]]


class Task(eqx.Module):
    """Anything that turns controls into a cost; its dynamics need not be MuJoCo's."""

    horizon: eqx.AbstractVar[int]
    num_controls: eqx.AbstractVar[int]

    @abstractmethod
    def run(
        self,
        controls: Float[Array, "horizon nu"] | Policy,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
    ) -> tuple[Float[Array, ""], PyTree]:
        """Roll out once.

        Args:
            controls: what to apply at each step, or a policy from parameters and a state to
                what to apply.
            params: the policy's parameters.
            noise: added to the controls.

        Returns:
            The cost, NaN if the rollout diverged, and the states that the controls were chosen
            in, with a leading axis of `horizon`.
        """


class SceneTask(Task):
    """A scene, where it starts, how long it runs, and what the trajectory costs.

    Attributes:
        scene: from `load_scene`.
        state: where every rollout begins.
        cost: from a trajectory to a number; traceable.
        horizon: number of steps.
    """

    scene: Scene
    state: State
    cost: Callable[[Trajectory], Float[Array, ""]]
    horizon: int = eqx.field(static=True)

    @property
    def num_controls(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Give the number of actuators."""
        return self.scene.model.nu

    def run(
        self,
        controls: Float[Array, "horizon nu"] | Policy,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
    ) -> tuple[Float[Array, ""], State]:
        """Roll out once; see `Task.run`. The states have no warm start: a policy must not depend on it."""
        has_activations = self.scene.model.na > 0
        trajectory = rollout(
            self.scene,
            self.state,
            controls,
            params,
            noise,
            horizon=self.horizon,
            observe=_activations if has_activations else None,
        )
        elapsed = self.scene.model.opt.timestep * jnp.arange(self.horizon)
        activations = trajectory.observations[:-1] if has_activations else jnp.zeros((self.horizon, 0))
        qpos, qvel = trajectory.qpos[:-1], trajectory.qvel[:-1]
        states = jax.vmap(State)(qpos, qvel, activations, self.state.time + elapsed, jnp.zeros_like(qvel))
        return finite_cost(self.cost(trajectory), trajectory), states


def finite_cost(cost: Float[Array, ""], trajectory: Trajectory) -> Float[Array, ""]:
    """Give the cost, or NaN if the rollout diverged, by which estimators know to leave it out."""
    return jnp.where(trajectory.diverged, jnp.nan, cost)


def _activations(model: mjx.Model, data: mjx.Data) -> Float[Array, " na"]:
    return data.act
