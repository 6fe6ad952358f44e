"""What the published tasks have in common where MJX simulates them: a quadratic cost, and settings to optimise it."""

import dataclasses
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
from mjxgrad.tasks.published import Published, QuadraticCost


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


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to optimise a task; found by trying, so that few steps show its story.

    Attributes:
        name: of the task.
        stddev: of the noise on the actions, in their units.
        num_samples: rollouts per estimate.
        learning_rate: of plain gradient descent.
        num_steps: of it.
        gamma: the bias that the published α-order rule may accept.
        bound: L of that rule.
        num_starts: over how many starts the final cost averages where they are random.
    """

    name: str
    stddev: float
    num_samples: int
    learning_rate: float
    num_steps: int
    gamma: float
    bound: float
    num_starts: int = 1


class StoryTask(SceneTask):
    """A published task with real contact; see `SceneTask`.

    Attributes:
        settings: to optimise it with.
        start_params: where the optimisation starts: the controls, or the policy's parameters.
        policy: from its parameters and a state to controls; None is open loop.
    """

    settings: Settings = eqx.field(static=True, kw_only=True)
    start_params: PyTree = eqx.field(kw_only=True)
    policy: Callable[[PyTree, Any], Float[Array, " nu"]] | None = eqx.field(kw_only=True, default=None)

    def with_softness(self, softness: Softness) -> "StoryTask":
        """Give the same task with other contact softness."""
        return eqx.tree_at(lambda task: task.scene, self, self.scene.with_softness(softness))

    def objective(
        self, stddev: float | Float[Array, "..."] | None = None, softness: Softness | None = None
    ) -> ActionNoise:
        """Give the cost under noise on the actions.

        Args:
            stddev: of the noise, in units of the controls; None takes that of the settings.
            softness: of contact; None leaves it as it is.

        Returns:
            The objective; its parameters are the controls, or those of the policy.
        """
        task = self if softness is None else self.with_softness(softness)
        stddev = self.settings.stddev if stddev is None else stddev
        if self.policy is None:
            return open_loop(task, stddev)
        return closed_loop(task, self.policy, stddev, params=self.start_params)

    def initial_params(self) -> Float[Array, " dim"]:
        """Give where the optimisation starts, as the flat vector that estimators take."""
        return ravel_pytree(self.start_params)[0]

    def problem(self) -> Published:
        """Give the task and its settings in the form of the published ones, without reference results."""
        settings = dataclasses.asdict(self.settings)
        del settings["stddev"]
        return Published(objective=self.objective(), params=self.initial_params(), reference={}, **settings)


def story_task(
    scene: Scene,
    cost: QuadraticCost,
    horizon: int,
    *,
    settings: Settings,
    start_params: PyTree,
    state: State | None = None,
    **policy_and_starts: Any,
) -> StoryTask:
    """Make a task.

    Args:
        scene: from `load_scene`.
        cost: of the vector of positions and velocities, and of the controls.
        horizon: number of steps.
        settings: to optimise it with.
        start_params: the controls, or the policy's parameters.
        state: the nominal start; None is the scene's reference pose at rest.
        **policy_and_starts: `policy`, `start_distribution` and `gradient` of `StoryTask`, where they are not the default.

    Returns:
        The task.
    """
    # The number of controls is the scene's; pyright takes it for an argument, since `Task` declares it as a variable.
    return StoryTask(  # pyright: ignore[reportCallIssue]
        scene=scene,
        state=initial_state(scene) if state is None else state,
        cost=StateCost(cost),
        horizon=horizon,
        settings=settings,
        start_params=start_params,
        **policy_and_starts,
    )
