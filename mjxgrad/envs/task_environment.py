"""The tasks of this project as environments: an episode is one rollout, rewarded at its end."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from mjxgrad.envs.environment import Environment, EnvState
from mjxgrad.objective.task import SceneTask
from mjxgrad.rollouts import State, Trajectory

Memory = dict[str, Array]


class TaskEnvironment(Environment):
    """A task whose controls an agent chooses step by step; see `from_task`.

    Attributes:
        task: the task, which gives start and cost.
    """

    task: SceneTask = eqx.field(kw_only=True)

    @property
    def action_limit(self) -> Float[Array, " nu"]:
        low, high = self.scene.ctrlrange.T
        return jnp.where(jnp.isfinite(high - low), 1.0, jnp.inf)

    def start(self, key: PRNGKeyArray) -> State:
        drawn = self.task.sample_start(key)
        begun = self.task.nominal_start() if drawn is None else drawn
        return dataclasses.replace(begun, time=jnp.zeros_like(begun.time))

    def first_memory(self, key: PRNGKeyArray) -> Memory:
        nominal = self.task.nominal_start()
        course = {name: _repeated(getattr(nominal, name), self.episode_length + 1) for name in ("qpos", "qvel", "act")}
        controls = jnp.zeros((self.episode_length, self.num_actions), nominal.qvel.dtype)
        return {**course, "ctrl": controls, "step": jnp.zeros((), jnp.int32)}

    def reset(self, key: PRNGKeyArray) -> EnvState:
        state = super().reset(key)
        begun = {
            name: _repeated(getattr(state.physics, name), self.episode_length + 1) for name in ("qpos", "qvel", "act")
        }
        return dataclasses.replace(state, memory={**state.memory, **begun})

    def next_memory(self, memory: Memory, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> Memory:
        step = memory["step"]
        # The rows to come hold the present state: the cost of an unfinished trajectory then has finite derivatives, too.
        course = {name: _from(step + 1, memory[name], getattr(after, name)) for name in ("qpos", "qvel", "act")}
        return {**course, "ctrl": _from(step, memory["ctrl"], self.control(action)), "step": step + 1}

    def observe(self, state: State, memory: Memory) -> Float[Array, " obs"]:
        elapsed = memory["step"][None].astype(state.qpos.dtype) / self.episode_length
        return jnp.concatenate([state.qpos, state.qvel, state.act, elapsed])

    def rewards(
        self, before: State, action: Float[Array, " nu"], after: State, memory: Memory
    ) -> dict[str, Float[Array, ""]]:
        course = self.next_memory(memory, action, after, jax.random.key(0))
        diverged = after.time <= before.time  # a rollout that diverged stays where it was
        trajectory = Trajectory(
            qpos=course["qpos"],
            qvel=course["qvel"],
            ctrl=course["ctrl"],
            observations=None,
            final=after,
            diverged=diverged,
            first_bad_step=jnp.where(diverged, memory["step"], -1),
            act=course["act"],
        )
        ends = diverged | (course["step"] == self.episode_length)
        return {"cost": jnp.where(ends, -jnp.sum(self.task.cost(trajectory)), 0.0)}

    def is_over(self, state: State) -> Bool[Array, ""]:
        return state.time > (self.episode_length - 0.5) * self.interval


def from_task(task: SceneTask) -> TaskEnvironment:
    """Return a task as an environment: `task.horizon` actions of one time step each.

    The reward of the last step is minus the task's cost, and all others are zero, so the return is minus the cost. An episode
    whose physics diverges ends there, charged as if the state had stayed constant. The end is part of the task: `terminated`,
    not `truncated`. Actions are scaled to `ctrlrange`; without limits they are the controls themselves. A policy observes
    positions, velocities, activations and the elapsed share of the time.

    Args:
        task: a task without `observe`; its own policy is not used.

    Raises:
        ValueError: if the task's cost needs observations.
    """
    if task.observe is not None:
        raise ValueError(f"task must have a cost of positions, velocities and controls, got observe={task.observe!r}")
    return TaskEnvironment(task.scene, task=task, episode_length=task.horizon, contact=task.contact)


def _repeated(value: Float[Array, " n"], num_states: int) -> Float[Array, "states n"]:
    return jnp.broadcast_to(value, (num_states, *value.shape))


def _from(step: Array, rows: Float[Array, "rows n"], value: Float[Array, " n"]) -> Float[Array, "rows n"]:
    """Return the rows with a value in all rows from a step on."""
    return jnp.where(jnp.arange(len(rows))[:, None] >= step, value, rows)
