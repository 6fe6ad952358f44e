"""Any environment as gymnasium's `Env` and `VectorEnv`; importing this registers `ENVIRONMENTS` there.

Their names are `mjxgrad/Hopper-v0`, `mjxgrad/DiffRLAnt-v0` and so on, for `gymnasium.make` and `gymnasium.make_vec`. Pass
your own environment to `GymEnv` or `GymVectorEnv`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from mjxgrad.envs import ENVIRONMENTS, load
from mjxgrad.envs.environment import Environment, EnvState
from mjxgrad.rollouts import render

try:
    import gymnasium
except ImportError as error:
    raise ImportError("mjxgrad.envs.gym needs gymnasium: pip install 'mjxgrad[envs]'") from error
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

_Info = dict[str, Any]
_METADATA: _Info = {"render_modes": ["rgb_array"]}


class GymEnv(gymnasium.Env):
    """One copy of an environment. `reset` draws its friction, masses and gains anew, if they are random.

    The environment's own `episode_length` is the only limit of steps.
    """

    metadata = _METADATA

    def __init__(self, environment: Environment | str, *, render_mode: str | None = None, **view: Any):
        """Prepare an environment; nothing is compiled before `reset` and `step`.

        Args:
            environment: the environment, or its name in `mjxgrad.envs.ENVIRONMENTS`.
            render_mode: "rgb_array" or None.
            view: `height`, `width` and `camera` of `mjxgrad.render.frames`. By default the scene's first camera, if any.

        Raises:
            ValueError: if there is no such environment or render mode.
        """
        self.environment = load(environment) if isinstance(environment, str) else environment
        self.render_mode = _checked(render_mode)
        self.metadata = _metadata(self.environment)
        self.observation_space, self.action_space = _spaces(self.environment)
        self._view = view
        self._begin = jax.jit(lambda key: _begin(self.environment, key))
        self._advance = jax.jit(
            lambda changes, state, action: self.environment.with_changes(changes).step(state, action)
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, _Info]:
        super().reset(seed=seed, options=options)
        self._changes, self._state = self._begin(_key(self.np_random))
        return np.asarray(self._state.obs), _info(self._state)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, _Info]:
        state = self._state = self._advance(self._changes, self._state, jnp.asarray(action))
        return np.asarray(state.obs), float(state.reward), bool(state.terminated), bool(state.truncated), _info(state)

    def render(self) -> np.ndarray | None:
        """Draw the present state, in the render mode "rgb_array"."""
        return (
            None
            if self.render_mode is None
            else _drawn(self.environment, self._state.physics.qpos[None], self._view)[0]
        )


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """Many copies of an environment in one program, each with its own friction, masses and gains, if they are random.

    A copy whose episode ends starts the next one in the same step: the observation is already the new one. `final_obs` and
    `final_info` hold the last ones of the old episode.
    """

    metadata = _METADATA

    def __init__(
        self, environment: Environment | str, num_envs: int = 1, *, render_mode: str | None = None, **view: Any
    ):
        """Prepare the copies; nothing is compiled before `reset` and `step`.

        Args:
            environment: the environment, or its name in `mjxgrad.envs.ENVIRONMENTS`.
            num_envs: number of copies.
            render_mode: "rgb_array" or None.
            view: see `GymEnv`.

        Raises:
            ValueError: if there is no such environment or render mode.
        """
        self.environment = load(environment) if isinstance(environment, str) else environment
        self.num_envs, self.render_mode = num_envs, _checked(render_mode)
        self.metadata = {**_metadata(self.environment), "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.single_action_space = _spaces(self.environment)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._view = view

        def begin(key: PRNGKeyArray) -> tuple[PyTree, EnvState]:
            return jax.vmap(lambda one: _begin(self.environment, one))(jax.random.split(key, num_envs))

        def advance(changes: PyTree, state: EnvState, action: Float[Array, " nu"]) -> tuple[EnvState, EnvState]:
            return self.environment.with_changes(changes).step_on(state, action)

        self._begin, self._advance = jax.jit(begin), jax.jit(jax.vmap(advance))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, _Info]:
        super().reset(seed=seed, options=options)
        self._changes, self._state = self._begin(_key(self.np_random))
        return np.asarray(self._state.obs), self._info(self._state)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, _Info]:
        ended, self._state = self._advance(self._changes, self._state, jnp.asarray(actions))
        done = np.asarray(ended.done)
        infos = {**self._ends(ended, done), **self._info(self._state)}
        outcome = (np.asarray(x) for x in (self._state.obs, ended.reward, ended.terminated, ended.truncated))
        return *outcome, infos  # pyright: ignore[reportReturnType]

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw the present state of each copy, in the render mode "rgb_array"."""
        return (
            None if self.render_mode is None else tuple(_drawn(self.environment, self._state.physics.qpos, self._view))
        )

    def _info(self, state: EnvState) -> _Info:
        """Return the metrics in gymnasium's layout: arrays, each with a mask of the copies that have it."""
        everyone = np.ones(self.num_envs, bool)
        return {k: v for name, x in state.metrics.items() for k, v in ((name, np.asarray(x)), (f"_{name}", everyone))}

    def _ends(self, ended: EnvState, done: Bool[np.ndarray, " envs"]) -> _Info:
        obs, metrics = np.asarray(ended.obs), {name: np.asarray(x) for name, x in ended.metrics.items()}
        infos: _Info = {}
        for i in np.flatnonzero(done).tolist():
            end = {"final_obs": obs[i], "final_info": {name: x[i] for name, x in metrics.items()}}
            infos = self._add_info(infos, end, i)
        return infos


def register() -> None:
    """Register `ENVIRONMENTS` with gymnasium."""
    for name in ENVIRONMENTS:
        place = f"{__name__}:"
        gymnasium.register(
            gym_name(name),
            entry_point=f"{place}{GymEnv.__name__}",
            vector_entry_point=f"{place}{GymVectorEnv.__name__}",
            kwargs={"environment": name},
        )


def gym_name(name: str) -> str:
    """Return gymnasium's name of one of `ENVIRONMENTS`: `diffrl_ant` is `mjxgrad/DiffRLAnt-v0`."""
    words = ["DiffRL" if word == "diffrl" else word.capitalize() for word in name.split("_")]
    return f"mjxgrad/{''.join(words)}-v0"


def _begin(environment: Environment, key: PRNGKeyArray) -> tuple[PyTree, EnvState]:
    copy_key, reset_key = jax.random.split(key)
    changes = environment.changes(copy_key)
    return changes, environment.with_changes(changes).reset(reset_key)


def _spaces(environment: Environment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    obs = jax.eval_shape(environment.reset, jax.random.key(0)).obs
    limit = np.asarray(environment.action_limit, np.float32)
    seen = gymnasium.spaces.Box(-np.inf, np.inf, obs.shape, obs.dtype)
    return seen, gymnasium.spaces.Box(-limit, limit, dtype=np.float32)


def _metadata(environment: Environment) -> _Info:
    return {**_METADATA, "render_fps": round(1 / float(environment.interval))}


def _checked(render_mode: str | None) -> str | None:
    if render_mode not in (None, *_METADATA["render_modes"]):
        raise ValueError(f'render_mode must be "rgb_array" or None, got {render_mode!r}')
    return render_mode


def _key(generator: np.random.Generator) -> PRNGKeyArray:
    return jax.random.key(int(generator.integers(2**31)))


def _info(state: EnvState) -> _Info:
    return {name: float(value) for name, value in state.metrics.items()}


def _drawn(environment: Environment, qpos: Float[Array, "states nq"], view: _Info) -> np.ndarray:
    first = 0 if environment.scene.mj_model.ncam else None
    # One state and one frame per second, so that every state is drawn.
    return render.frames(environment.scene, qpos, timestep=1.0, fps=1.0, **{"camera": first, **view})


register()
