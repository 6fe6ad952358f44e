"""Any environment as gymnasium's `Env` and `VectorEnv`; importing this registers `ENVIRONMENTS` there.

Their names are `mjxgrad/Hopper-v0`, `mjxgrad/DiffRLAnt-v0` and so on, for `gymnasium.make` and `gymnasium.make_vec`. Pass
your own environment to `GymEnv` or `GymVectorEnv`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import instance, one_of, real, whole
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
_Named = Environment | str
_VIEW = ("height", "width", "camera")


class _Adapter:
    """The parts that one copy and many have in common: the environment, its spaces, and pictures of it."""

    metadata: _Info = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def _prepare(self, environment: _Named, render_mode: str | None, view: _Info) -> None:
        self.environment = load(environment) if isinstance(environment, str) else environment
        instance("environment", self.environment, Environment, "of mg.envs.Environment, or the name of one")
        for name in view:
            one_of("an option", name, ("render_mode", *_VIEW))
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f'render_mode must be "rgb_array" or None, got {render_mode!r}')
        self.render_mode, self._view, self._state = render_mode, view, None
        self.metadata = {**self.metadata, "render_fps": round(1 / float(self.environment.interval))}

    def __repr__(self) -> str:
        is_many = isinstance(self, GymVectorEnv)
        seen, action = (
            getattr(self, f"{'single_' * is_many}{kind}_space").shape[0] for kind in ("observation", "action")
        )
        copies = f", {self.num_envs} copies" if is_many else ""
        sizes = f"{seen} observed numbers, {action} action{'s' * (action != 1)}"
        return f"{type(self).__name__}({self.environment.scene.name}: {sizes}{copies})"

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, _Info]:
        super().reset(seed=seed, options=options)
        self._copy_key, self._state = self._begin(jax.random.key(int(self.np_random.integers(2**31))))
        return np.asarray(self._state.obs), self._info(self._state)

    def _given(self, action: np.ndarray) -> tuple[Array, EnvState, Array]:
        """Return the copies' keys, their states and an action, of which all numbers are finite."""
        state, action, shape = self._begun("step"), np.asarray(real("action", action)), self.action_space.shape
        if action.shape != shape:
            raise ValueError(f"action must have shape {shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"action must be finite, got {np.count_nonzero(~np.isfinite(action))} that are not")
        return self._copy_key, state, jnp.asarray(action)

    def _begun(self, method: str) -> EnvState:
        if self._state is None:
            raise gymnasium.error.ResetNeeded(f"Cannot call env.{method}() before calling env.reset()")
        return self._state

    def _spaces(self) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
        obs = jax.eval_shape(self.environment.reset, jax.random.key(0)).obs
        seen = gymnasium.spaces.Box(-np.inf, np.inf, obs.shape, obs.dtype)
        return seen, gymnasium.spaces.Box(-1, 1, (self.environment.num_actions,))

    def _drawn(self, qpos: Float[Array, "states nq"]) -> np.ndarray:
        first = 0 if self.environment.scene.mj_model.ncam else None
        # One state and one frame per second, so that every state is drawn.
        return render.frames(self.environment.scene, qpos, timestep=1.0, fps=1.0, **{"camera": first, **self._view})


class GymEnv(_Adapter, gymnasium.Env):
    """One copy of an environment, limited by its `episode_length`; `reset` draws what is random in it anew."""

    def __init__(self, environment: _Named, *, render_mode: str | None = None, **view: Any):
        """Prepare an environment, or one of `mjxgrad.envs.ENVIRONMENTS` by name; nothing is compiled before `reset` and `step`.

        The render mode is "rgb_array" or None. The view is `height`, `width` and `camera` of `mjxgrad.render.frames`, by default
        the scene's first camera, if any.

        Raises:
            ValueError: if there is no such environment, option or render mode.
        """
        self._prepare(environment, render_mode, view)
        self.observation_space, self.action_space = self._spaces()
        self._begin = jax.jit(lambda key: self.environment.begin(key))
        self._advance = jax.jit(lambda key, state, action: self.environment.randomised(key).step(state, action))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, _Info]:
        state = self._state = self._advance(*self._given(action))
        ends = bool(state.terminated), bool(state.truncated)
        return np.asarray(state.obs), float(state.reward), *ends, self._info(state)

    def render(self) -> np.ndarray | None:
        """Draw the present state, in the render mode "rgb_array"."""
        return None if self.render_mode is None else self._drawn(self._begun("render").physics.qpos[None])[0]

    def _info(self, state: EnvState) -> _Info:
        return {name: float(value) for name, value in state.metrics.items()}


class GymVectorEnv(_Adapter, gymnasium.vector.VectorEnv):
    """Many copies of an environment in one program, each with its own draw of what is random.

    A copy whose episode ends starts the next one in the same step: the observation is already the new one. `final_obs` and
    `final_info` hold the last ones of the old episode.
    """

    def __init__(self, environment: _Named, num_envs: int = 1, *, render_mode: str | None = None, **view: Any):
        """Prepare `num_envs` copies; the other arguments, and errors, are those of `GymEnv`."""
        self._prepare(environment, render_mode, view)
        self.num_envs = num_envs = whole("num_envs", num_envs)
        self.metadata = {**self.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.single_action_space = self._spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._begin = jax.jit(lambda key: jax.vmap(self.environment.begin)(jax.random.split(key, num_envs)))
        advance = lambda key, state, action: self.environment.randomised(key).step_on(state, action)  # noqa: E731
        self._advance = jax.jit(jax.vmap(advance))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, _Info]:
        ended, self._state = self._advance(*self._given(actions))
        done = np.asarray(ended.done)
        infos = {**self._ends(ended, done), **self._info(self._state)}
        outcome = (np.asarray(x) for x in (self._state.obs, ended.reward, ended.terminated, ended.truncated))
        return *outcome, infos  # pyright: ignore[reportReturnType]

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw the present state of each copy, in the render mode "rgb_array"."""
        return None if self.render_mode is None else tuple(self._drawn(self._begun("render").physics.qpos))

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


def gym_name(name: str) -> str:
    """Return gymnasium's name of one of `ENVIRONMENTS`: `diffrl_ant` is `mjxgrad/DiffRLAnt-v0`."""
    words = ["DiffRL" if word == "diffrl" else word.capitalize() for word in name.split("_")]
    return f"mjxgrad/{''.join(words)}-v0"


_points: _Info = {"entry_point": f"{__name__}:GymEnv", "vector_entry_point": f"{__name__}:GymVectorEnv"}
for _name in ENVIRONMENTS:
    gymnasium.register(gym_name(_name), **_points, kwargs={"environment": _name})
