"""A scene to be controlled by actions under noise, and where its optimisation starts; the published tasks in MJX are such."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from mjxgrad._rollout import State, Trajectory, initial_state
from mjxgrad.contact import Softness
from mjxgrad.objective import ActionNoise, closed_loop, open_loop
from mjxgrad.scene import Scene
from mjxgrad.task import SceneTask
from mjxgrad.tasks.published import QuadraticCost


class StateCost(eqx.Module):
    """A quadratic cost of positions and velocities, in this order.

    Attributes:
        quadratic: of the state vector and the controls.
    """

    quadratic: QuadraticCost

    def __call__(self, trajectory: Trajectory) -> Float[Array, " steps"]:
        """Give the cost of every state: that of a step, and after the last step the final one."""
        states = jnp.concatenate([trajectory.qpos, trajectory.qvel], axis=1)
        charged = jax.vmap(self.quadratic.stage)(states[:-1], trajectory.ctrl)
        return jnp.append(charged, self.quadratic.terminal(states[-1]))


class ActionTask(SceneTask):
    """A task with an objective of its own; see `SceneTask`.

    Attributes:
        start_params: where the optimisation starts: the controls, or the policy's parameters.
        policy: from its parameters and a state to controls; None is open loop.
        stddev: of the noise on the actions, in their units, unless another is given.
    """

    start_params: PyTree = eqx.field(kw_only=True)
    policy: Callable[[PyTree, Any], Float[Array, " nu"]] | None = eqx.field(kw_only=True, default=None)
    stddev: float = eqx.field(static=True, kw_only=True, default=0.1)

    def objective(
        self, stddev: float | Float[Array, "..."] | None = None, softness: Softness | None = None
    ) -> ActionNoise:
        """Give the cost under noise on the actions.

        Args:
            stddev: of the noise, in units of the controls; None takes that of the task.
            softness: of contact; None leaves it as it is.

        Returns:
            The objective; its parameters are the controls, or those of the policy.
        """
        task = self if softness is None else self.with_softness(softness)
        stddev = self.stddev if stddev is None else stddev
        if self.policy is None:
            return open_loop(task, stddev)
        return closed_loop(task, self.policy, stddev, params=self.start_params)

    def initial_params(self) -> Float[Array, " dim"]:
        """Give where the optimisation starts, as the flat vector that estimators take."""
        return ravel_pytree(self.start_params)[0]


def quadratic_task(
    scene: Scene,
    cost: QuadraticCost,
    horizon: int,
    *,
    start_params: PyTree,
    state: State | None = None,
    **options: Any,
) -> ActionTask:
    """Make a task with a quadratic cost.

    Args:
        scene: from `load_scene`.
        cost: of the vector of positions and velocities, and of the controls.
        horizon: number of steps.
        start_params: the controls, or the policy's parameters.
        state: the nominal start; None is the scene's reference pose at rest.
        **options: `policy`, `stddev`, `start_distribution` and `gradient` of `ActionTask`, where they are not the default.

    Returns:
        The task.
    """
    # The number of controls is the scene's; pyright takes it for an argument, since `Task` declares it as a variable.
    return ActionTask(  # pyright: ignore[reportCallIssue]
        scene=scene,
        state=initial_state(scene) if state is None else state,
        cost=StateCost(cost),
        horizon=horizon,
        start_params=start_params,
        **options,
    )
