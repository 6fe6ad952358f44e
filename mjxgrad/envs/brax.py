"""Any environment as a brax environment, for brax's learners.

Brax 0.14.2 calls `jax.device_put_replicated`, which jax 0.10 has removed: its learners need an earlier jax, or a
substitute for this function.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

from mjxgrad.envs.environment import Environment, EnvState

try:
    from brax.envs.base import Env, State  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError("mjxgrad.envs.brax needs brax: pip install 'mjxgrad[playground]'") from error


class BraxEnv(Env):
    """An environment for brax: `ppo.train(BraxEnv(environment), episode_length=environment.episode_length, ...)`.

    Brax's wrappers reset it and end it by the learner's episode length; `done` is only an end for good. Each copy draws what
    is random in `reset` and keeps it.
    """

    def __init__(self, environment: Environment):
        self.environment = environment

    def reset(self, rng: PRNGKeyArray | UInt32[Array, "2"]) -> State:
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        copy_key, now = self.environment.begin(key)
        return _brax_state(State(None, None, None, None, info={"copy_key": copy_key}), now)  # pyright: ignore[reportArgumentType]

    def step(self, state: State, action: Float[Array, " nu"]) -> State:
        before: EnvState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        return _brax_state(state, self.environment.randomised(state.info["copy_key"]).step(before, action))

    @property
    def observation_size(self) -> int:
        return self.environment.num_observations

    @property
    def action_size(self) -> int:
        return self.environment.num_actions

    @property
    def backend(self) -> str:
        return "mjx"

    @property
    def dt(self) -> float:
        """Time between two actions (s)."""
        return float(self.environment.interval)


def _brax_state(state: State, now: EnvState) -> State:
    done = now.terminated.astype(now.obs.dtype)
    # Wrappers add to the metrics in place.
    metrics = {**state.metrics, **now.metrics}
    return state.replace(pipeline_state=now, obs=now.obs, reward=now.reward, done=done, metrics=metrics)
