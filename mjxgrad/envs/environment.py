"""Environments: a scene, where episodes start and end, what is seen and what it is worth, as pure functions.

`reset(key)` and `step(state, action)` are those of brax and MuJoCo Playground: traceable, mapped over batches by `jax.vmap`,
differentiated by `jax.grad`, and compiled as `jax.jit(lambda state, action: env.step(state, action))`: a method of a pytree of
arrays has no hash, which `jax.jit(env.step)` would need. An environment of one's own gives three or four methods and inherits
the rest.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad._arrays import whole
from mjxgrad.objective.task import InScene, optional_pytree
from mjxgrad.rollouts import State, Trajectory, initial_state, rollout
from mjxgrad.scene import Scene
from mjxgrad.stepping import Gradient

Randomisation = Callable[[PRNGKeyArray, Scene], Scene]
"""From a key and a scene to one with other friction, masses, gains, by `scene.with_model`."""


class EnvState(eqx.Module):
    """What an environment is in, and what the step that led there brought; under `jax.vmap` every field gains leading axes.

    Attributes:
        physics: positions, velocities and activations.
        obs: what a policy sees.
        reward: of the step.
        terminated: whether the episode ended there for good: it fell, it arrived, its state left all numbers.
        truncated: whether only its time was up. A value function goes on beyond such an end.
        metrics: the terms of the reward by name, and `diverged`, 1 where the physics had no meaningful next state.
        num_steps: since the start of the episode.
        memory: what the task keeps in mind, such as a command or the last action.
        key: for what is drawn later.
    """

    physics: State
    obs: Float[Array, " obs"]
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    metrics: dict[str, Float[Array, ""]]
    num_steps: Int[Array, ""]
    memory: PyTree
    key: PRNGKeyArray

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """Whether the episode ended, for whatever reason."""
        return self.terminated | self.truncated


class Environment(InScene):
    """A scene with a reward; a subclass says what is seen, what counts, where it starts and when it is over.

    An action has one number per actuator, from −1 to 1, the ends of its `ctrlrange`; beyond them nothing changes. It holds for
    `frame_skip` time steps. The motion is MuJoCo's own, in which policies are judged, with the derivative of its steps: ants and
    hoppers learn most by it. `with_gradient("slope")` takes that of the outcome, `with_onset(mg.Onset())` a continuous motion,
    `with_engine("mujoco")` C MuJoCo.

    Attributes:
        frame_skip: time steps per action.
        episode_length: actions after which time is up.
        randomisation: from a key and the scene to the scene of one copy; see `randomised`.
    """

    gradient: Gradient = eqx.field(static=True, default="discrete", kw_only=True)
    frame_skip: int = eqx.field(static=True, default=1, kw_only=True)
    episode_length: int = eqx.field(static=True, default=1000, kw_only=True)
    randomisation: Randomisation | None = eqx.field(converter=optional_pytree, default=None, kw_only=True)

    def __check_init__(self):
        for name in ("frame_skip", "episode_length"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    @abstractmethod
    def observe(self, state: State, memory: PyTree) -> Float[Array, " obs"]:
        """Return what a policy sees."""

    @abstractmethod
    def rewards(
        self, before: State, action: Float[Array, " nu"], after: State, memory: PyTree
    ) -> dict[str, Float[Array, ""]]:
        """Return the terms of the reward of one step, whose sum it is.

        Args:
            before: where the action was chosen.
            action: as it was given, clipped to −1 and 1.
            after: where it led.
            memory: at the time when it was chosen.
        """

    def start(self, key: PRNGKeyArray) -> State:
        """Draw where an episode starts; by default the scene's reference pose."""
        return initial_state(self.scene)

    def is_over(self, state: State) -> Bool[Array, ""]:
        """Return whether a state ends the episode for good; by default none does."""
        return jnp.array(False)

    def first_memory(self, key: PRNGKeyArray) -> PyTree:
        """Draw what the task keeps in mind at the start; by default nothing."""
        return None

    def next_memory(self, memory: PyTree, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> PyTree:
        """Return what it keeps in mind after a step; by default the same."""
        return memory

    def disturbed(self, state: State, memory: PyTree) -> State:
        """Return where a step really begins, pushes included; by default the same."""
        return state

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        """Return the controls of an action: −1 and 1 are the ends of `ctrlrange`; without a range it is the control itself."""
        low, high = self.scene.ctrlrange.T
        is_bounded = jnp.isfinite(high - low)
        middle, half = (jnp.where(is_bounded, x / 2, y) for x, y in ((low + high, 0.0), (high - low, 1.0)))
        return middle + half * action

    @property
    def action_limit(self) -> Float[Array, " nu"]:
        """What actions are clipped to, on both sides."""
        return jnp.ones(self.num_actions)

    @property
    def num_actions(self) -> int:
        return self.scene.model.nu

    @property
    def num_observations(self) -> int:
        state = jax.eval_shape(lambda: self.reset(jax.random.key(0)))
        return state.obs.shape[0]

    @property
    def interval(self) -> Float[Array, ""]:
        """Time between two actions (s)."""
        return self.frame_skip * self.scene.model.opt.timestep

    def reset(self, key: PRNGKeyArray) -> EnvState:
        """Begin an episode.

        Args:
            key: consumed here; it decides all that is drawn until the next reset.
        """
        start_key, memory_key, next_key = jax.random.split(key, 3)
        physics, memory = self.start(start_key), self.first_memory(memory_key)
        obs = self.observe(physics, memory)
        action = jnp.zeros(self.num_actions, obs.dtype)
        terms = jax.eval_shape(lambda: self.rewards(physics, action, physics, memory))
        zero, no = jnp.zeros((), obs.dtype), jnp.array(False)
        metrics = dict.fromkeys([*terms, "diverged"], zero)
        return EnvState(physics, obs, zero, no, no, metrics, jnp.zeros((), jnp.int32), memory, next_key)

    def step(self, state: EnvState, action: Float[Array, " nu"]) -> EnvState:
        """Let an action act for `frame_skip` time steps; what comes after an end is the caller's, see `step_on`.

        Raises:
            ValueError: if the action does not have one number per actuator.
        """
        if action.shape != (self.num_actions,):
            remedy = "map over batches with jax.vmap"
            raise ValueError(f"action must have shape ({self.num_actions},), got {action.shape}: {remedy}")
        action = jnp.clip(action, -self.action_limit, self.action_limit)
        key, memory_key = jax.random.split(state.key)
        course = self._move(self.disturbed(state.physics, state.memory), self.control(action))
        after = course.final
        terms = self.rewards(state.physics, action, after, state.memory)
        memory = self.next_memory(state.memory, action, after, memory_key)
        num_steps = state.num_steps + 1
        obs = self.observe(after, memory)
        terminated = self.is_over(after) | course.diverged
        return EnvState(
            physics=after,
            obs=obs,
            reward=jnp.asarray(sum(terms.values()), obs.dtype),
            terminated=terminated,
            truncated=(num_steps >= self.episode_length) & ~terminated,
            metrics={**terms, "diverged": course.diverged.astype(obs.dtype)},
            num_steps=num_steps,
            memory=memory,
            key=key,
        )

    def _move(self, physics: State, ctrl: Float[Array, " nu"]) -> Trajectory:
        return rollout(
            self.scene,
            physics,
            jnp.broadcast_to(ctrl, (self.frame_skip, self.num_actions)),
            gradient=self.gradient,
            onset=self.onset,
            smoothing=self.smoothing,
            engine=self.engine,
        )

    def step_on(self, state: EnvState, action: Float[Array, " nu"]) -> tuple[EnvState, EnvState]:
        """Step, and begin anew where that ended the episode.

        Returns:
            What the step led to, with its reward, and where to go on: the same, or the start of the next episode, on which no
            derivative by what came before depends.
        """
        stepped = self.step(state, action)
        key, fresh_key = jax.random.split(stepped.key)
        fresh = jax.lax.stop_gradient(self.reset(fresh_key))
        following = jax.tree.map(lambda new, old: jnp.where(stepped.done, new, old), fresh, stepped)
        return stepped, dataclasses.replace(following, key=key)

    def randomised(self, key: PRNGKeyArray) -> "Environment":
        """Return a copy with its own friction, masses, gains, as `randomisation` draws them; under `jax.vmap`, many."""
        if self.randomisation is None:
            return self
        return dataclasses.replace(self, scene=self.randomisation(key, self.scene))

    def refined(self, times: int) -> "Environment":
        """Return the same with so many times shorter time steps; an action takes as long.

        Where contact lasts few time steps, what a policy is worth is a property of the step as well as of the scene. Judged
        in shorter ones, it is that of the scene.

        Raises:
            ValueError: if `times` is no whole number, or below 1.
        """
        times = whole("times", times)
        scene = eqx.tree_at(lambda s: s.model.opt.timestep, self.scene, self.scene.model.opt.timestep / times)
        return dataclasses.replace(self, scene=scene, frame_skip=times * self.frame_skip)

    def changes(self, key: PRNGKeyArray) -> PyTree:
        """Draw what sets one copy apart, see `randomised`; in a batch of them the copies share all else.

        Returns:
            Its own numbers, for `with_changes`.
        """
        pairs = zip(jax.tree.leaves(self.randomised(key)), jax.tree.leaves(self), strict=True)
        return [None if copied is own else copied for copied, own in pairs]

    def with_changes(self, changes: PyTree) -> "Environment":
        """Return the copy whose own numbers `changes` drew."""
        own, structure = jax.tree.flatten(self)
        return structure.unflatten([x if new is None else new for x, new in zip(own, changes, strict=True)])
