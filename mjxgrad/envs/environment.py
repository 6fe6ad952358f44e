"""Environments: a scene with starts and ends of episodes, observations and rewards, as pure functions.

`reset(key)` and `step(state, action)` are like those of brax and MuJoCo Playground: traceable, mapped over batches by
`jax.vmap` and differentiated by `jax.grad`. Compile them as `jax.jit(lambda state, action: env.step(state, action))`, since
`jax.jit(env.step)` would need a hash, which a pytree of arrays has not.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad._arrays import function, instance, one_key, real, traceable, whole
from mjxgrad.engines import engine_of
from mjxgrad.engines.engine import Observe
from mjxgrad.objective.base import as_scalar
from mjxgrad.objective.task import InScene, as_pytree
from mjxgrad.rollouts import State, initial_state, rollout
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, Discrete

_DIVERGED = "diverged"  # in the metrics, beside the terms of the reward
Rewards = dict[str, Float[Array, ""]]
Randomisation = Callable[[PRNGKeyArray, Scene], Scene]
"""A function from a key and a scene to a scene with other friction, masses or gains, by `scene.with_model`."""


class EnvState(eqx.Module):
    """The state of an environment, with the result of the last step; under `jax.vmap` every field gains leading axes.

    Attributes:
        physics: positions, velocities and activations.
        obs: observation of the policy.
        privileged: further input of the value function, see `Environment.privileged`.
        reward: reward of the last step.
        terminated: whether the episode ended for good: a fall, an arrival, or a state that is not finite.
        truncated: whether only the time was up. A value function continues beyond such an end.
        metrics: the terms of the reward by name, and `diverged`, 1 where the physics had no meaningful next state.
        num_steps: steps since the start of the episode.
        memory: the task's own state, such as a command or the last action.
        key: key of all later draws.
    """

    physics: State
    obs: Float[Array, " obs"]
    privileged: Float[Array, " privileged"]
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    metrics: dict[str, Float[Array, ""]]
    num_steps: Int[Array, ""]
    memory: PyTree
    key: PRNGKeyArray

    @property
    def seen(self) -> Float[Array, "*batch seen"]:
        """Input of the value function: the observation, and what is privileged behind it."""
        return jnp.concatenate([self.obs, self.privileged], axis=-1)

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """Whether the episode ended for any reason."""
        return self.terminated | self.truncated


class Environment(InScene):
    """A scene with a reward; a subclass defines observations, rewards, starts and ends.

    An action has one number per actuator, clipped to −1 and 1, the ends of its `ctrlrange`. It holds for `frame_skip` time
    steps. The motion is MuJoCo's own, in which policies are judged, with the derivative of its steps; ants and hoppers learn
    most with it. `with_contact(mg.Slope())` takes the derivative of the outcome, `with_contact(mg.Onset())` a continuous
    motion, and `with_engine("mujoco")` lets C MuJoCo step.

    Attributes:
        frame_skip: time steps per action.
        episode_length: number of actions after which the time is up.
        randomisation: function from a key and the scene to the scene of one copy; see `randomised`.
    """

    contact: Contact = eqx.field(default=Discrete(), kw_only=True)
    frame_skip: int = eqx.field(static=True, default=1, kw_only=True)
    episode_length: int = eqx.field(static=True, default=1000, kw_only=True)
    randomisation: Randomisation | None = eqx.field(converter=as_pytree, default=None, kw_only=True)

    def __check_init__(self):
        for name in ("frame_skip", "episode_length"):
            whole(name, getattr(self, name))
        function("randomisation", self.randomisation, "key", "scene")

    @abstractmethod
    def observe(self, state: State, memory: PyTree) -> Float[Array, " obs"]:
        """Return the observation of the policy."""

    def privileged(self, state: State, memory: PyTree) -> Float[Array, " privileged"]:
        """Return what the value function sees besides while learning, such as a speed that the robot cannot measure."""
        return jnp.zeros(0, state.qpos.dtype)

    @abstractmethod
    def rewards(self, before: State, action: Float[Array, " nu"], after: State, memory: PyTree) -> Rewards:
        """Return the terms of the reward of one step; the reward is their sum.

        The action, clipped to −1 and 1, was chosen in the state `before` with this memory.
        """

    def start(self, key: PRNGKeyArray) -> State:
        """Draw the start of an episode; by default the scene's reference pose."""
        return initial_state(self.scene)

    def is_over(self, state: State) -> Bool[Array, ""]:
        """Return whether a state ends the episode for good; by default none does."""
        return jnp.array(False)

    def first_memory(self, key: PRNGKeyArray) -> PyTree:
        """Draw the memory at the start; by default None."""
        return None

    def next_memory(self, memory: PyTree, action: Float[Array, " nu"], after: State, key: PRNGKeyArray) -> PyTree:
        """Return the memory after a step; by default unchanged."""
        return memory

    def disturbed(self, state: State, memory: PyTree) -> State:
        """Return the state from which a step begins, pushes included; by default unchanged."""
        return state

    def control(self, action: Float[Array, " nu"]) -> Float[Array, " nu"]:
        """Return the controls of an action: −1 and 1 are the ends of `ctrlrange`; without a range, the action itself."""
        low, high = self.scene.ctrlrange.T
        is_bounded = jnp.isfinite(high - low)
        middle, half = (jnp.where(is_bounded, x / 2, y) for x, y in ((low + high, 0.0), (high - low, 1.0)))
        return middle + half * action

    def look(self, state: State, observe: Observe, action: Float[Array, " nu"] | None = None) -> PyTree:
        """Return what a function of model and data sees in a state, such as `mg.sensor(model, data, "touch")`.

        `observe`, `privileged` and `rewards` call it for what a state does not tell: sensors, and places of bodies, geoms and
        sites, by either engine; with MJX forces, too. It takes a step's time without its integration, so call it once.

        Args:
            state: positions, velocities and activations.
            observe: the function.
            action: on which accelerations and forces depend; by default 0.
        """
        controls = self.control(jnp.zeros(self.num_actions, state.qpos.dtype) if action is None else action)
        return engine_of(self.scene, self.contact).look(self.scene, state, controls, {}, observe, self.contact)

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

    @traceable("an environment's start, observe or rewards")
    def reset(self, key: PRNGKeyArray) -> EnvState:
        """Begin an episode; the key is consumed, and decides all draws until the next reset."""
        one_key(key)
        start_key, memory_key, next_key = jax.random.split(key, 3)
        physics, memory = self.start(start_key), self.first_memory(memory_key)
        name = type(self).__name__
        instance(f"what start of {name} returns", physics, State, "of mg.initial_state")
        physics = self.completed(physics)
        obs = self._vector("observe", self.observe(physics, memory))
        action = jnp.zeros(self.num_actions, obs.dtype)
        terms = jax.eval_shape(lambda: self._terms(physics, action, physics, memory, obs.dtype))
        zero, no = jnp.zeros((), obs.dtype), jnp.array(False)
        metrics = dict.fromkeys([*terms, _DIVERGED], zero)
        counter, hidden = jnp.zeros((), jnp.int32), self._vector("privileged", self.privileged(physics, memory))
        return EnvState(physics, obs, hidden, zero, no, no, metrics, counter, memory, next_key)

    def _vector(self, name: str, value: Any, size: int | None = None) -> Float[Array, " size"]:
        """Return what a method of the subclass gave as floats."""
        name = f"{name} of {type(self).__name__}"
        vector = real(name, value)
        if vector.ndim != 1 or (size is not None and len(vector) != size):
            wanted = "a vector" if size is None else f"a vector of shape ({size},)"
            raise ValueError(f"{name} must return {wanted}, got shape {vector.shape}")
        return vector.astype(jnp.result_type(vector, float))

    def _terms(self, before: State, action: Array, after: State, memory: PyTree, dtype: Any) -> Rewards:
        """Return the terms of the reward as floats."""
        terms, name = self.rewards(before, action, after, memory), f"rewards of {type(self).__name__}"
        instance(f"what {name} returns", terms, dict, 'a dict of numbers by name, such as {"speed": ...}')
        if not terms or not all(isinstance(term, str) for term in terms) or {"reward", _DIVERGED} & terms.keys():
            wanted = "must name at least one number, by text other than 'reward' and 'diverged'"
            raise ValueError(f"{name} {wanted}, got {list(terms)}")
        return {term: as_scalar(value, f"{term!r} in {name}").astype(dtype) for term, value in terms.items()}

    def completed(self, physics: State) -> State:
        """Return a state with all that this environment's contact carries, such as the pairs of motions of a slope."""
        return engine_of(self.scene, self.contact).complete(self.scene, physics, self.contact)

    @traceable("an environment's observe, rewards or is_over")
    def step(self, state: EnvState, action: Float[Array, " nu"]) -> EnvState:
        """Apply an action for `frame_skip` time steps; an episode that ended is not reset, see `step_on`.

        Raises:
            ValueError: if the action does not have one number per actuator, or a method returns something of another form than
                at the reset.
        """
        action = real("action", action)
        instance("state", state, EnvState, "of reset or step")
        if action.shape != (self.num_actions,):
            remedy = "map over batches with jax.vmap"
            raise ValueError(f"action must have shape ({self.num_actions},), got {action.shape}: {remedy}")
        action, name, dtype = jnp.clip(action, -1, 1), type(self).__name__, state.obs.dtype
        key, memory_key = jax.random.split(state.key)
        control = self._vector("control", self.control(action), self.num_actions)
        controls = jnp.broadcast_to(control, (self.frame_skip, self.num_actions))
        physics = self.disturbed(state.physics, state.memory)
        instance(f"what disturbed of {name} returns", physics, State, "a state, as it was given")
        course = rollout(self.scene, physics, controls, contact=self.contact)
        after = course.final
        terms = self._terms(state.physics, action, after, state.memory, dtype)
        memory = self.next_memory(state.memory, action, after, memory_key)
        forms = [jax.tree.map(lambda x: jax.typeof(x).str_short(), one) for one in (state.memory, memory)]
        if jax.tree.flatten(forms[0]) != jax.tree.flatten(forms[1]):
            raise ValueError(
                f"next_memory of {name} must return what has the form of its memory, {forms[0]}, got {forms[1]}"
            )
        num_steps = state.num_steps + 1
        obs = self._vector("observe", self.observe(after, memory), state.obs.size)
        hidden = self._vector("privileged", self.privileged(after, memory), state.privileged.size)
        is_over = self.is_over(after)
        if (
            not eqx.is_array_like(is_over)
            or jnp.shape(is_over)
            or not jnp.issubdtype(jnp.result_type(is_over), jnp.bool)
        ):
            given = jax.typeof(is_over).str_short() if eqx.is_array_like(is_over) else type(is_over).__name__
            raise ValueError(f"is_over of {name} must return True or False, got {given}")
        terminated = is_over | course.diverged
        truncated = (num_steps >= self.episode_length) & ~terminated
        reward, metrics = jnp.asarray(sum(terms.values()), dtype), {**terms, _DIVERGED: course.diverged.astype(dtype)}
        return EnvState(after, obs, hidden, reward, terminated, truncated, metrics, num_steps, memory, key)

    def step_on(self, state: EnvState, action: Float[Array, " nu"]) -> tuple[EnvState, EnvState]:
        """Step, and start a new episode where the step ended one.

        Returns:
            The state after the step, with its reward, and the state to continue from: the same, or the start of the next
            episode, whose derivative by anything before is zero.
        """
        stepped = self.step(state, action)
        key, fresh_key = jax.random.split(stepped.key)
        fresh = jax.lax.stop_gradient(self.reset(fresh_key))
        # A state from another environment may have other pairs, or none.
        if jax.tree.structure(fresh) != jax.tree.structure(stepped):
            physics = dataclasses.replace(fresh.physics, pairs=stepped.physics.pairs)
            fresh = dataclasses.replace(fresh, physics=physics)
        following = jax.tree.map(lambda new, old: jnp.where(stepped.done, new, old), fresh, stepped)
        return stepped, dataclasses.replace(following, key=key)

    def randomised(self, key: PRNGKeyArray) -> "Environment":
        """Return a copy whose friction, masses and gains `randomisation` has drawn; under `jax.vmap`, many."""
        if self.randomisation is None:
            return self
        scene = self.randomisation(key, self.scene)
        instance("what randomisation returns", scene, Scene, "a scene, by scene.with_model")
        return dataclasses.replace(self, scene=scene)

    def refined(self, times: int) -> "Environment":
        """Return the environment with time steps shorter by a factor of `times`; an action lasts as long as before.

        Where contact lasts few time steps, a policy's return depends on the time step as well as on the scene.

        Raises:
            ValueError: if `times` is no whole number, or below 1.
        """
        times = whole("times", times)
        scene = eqx.tree_at(lambda s: s.model.opt.timestep, self.scene, self.scene.model.opt.timestep / times)
        return dataclasses.replace(self, scene=scene, frame_skip=times * self.frame_skip)

    def begin(self, key: PRNGKeyArray) -> tuple[PRNGKeyArray, EnvState]:
        """Return the key of one copy, for `randomised`, and the start of its first episode."""
        copy_key, reset_key = jax.random.split(key)
        return copy_key, self.randomised(copy_key).reset(reset_key)
