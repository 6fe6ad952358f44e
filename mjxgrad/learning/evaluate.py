"""Evaluation of a policy in C MuJoCo rather than in the simulator that it was trained in."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mjxgrad._arrays import function, instance, is_known, one_key, one_of, traceable, whole
from mjxgrad._programs import compile_once
from mjxgrad._text import format_number
from mjxgrad.engines import ENGINES, QUICK
from mjxgrad.envs import Environment, EnvState
from mjxgrad.stepping import Discrete, EngineName


class Evaluation(eqx.Module):
    """Some episodes without noise on the actions, each from its own start.

    Attributes:
        returns: sum of the rewards of each episode.
        lengths: number of actions until the end.
        terminated: whether an episode ended before its time.
        qpos: positions at each action and after the last; after the end of an episode they stay constant.
        terms: terms of the reward by name, as means per step.
    """

    returns: Float[Array, "*episodes"]
    lengths: Int[Array, "*episodes"]
    terminated: Bool[Array, "*episodes"]
    qpos: Float[Array, "*episodes states nq"]
    terms: dict[str, Float[Array, "*episodes"]]

    def __repr__(self) -> str:
        if not all(map(is_known, (self.returns, self.lengths, self.terminated))):
            return super().__repr__()
        returns, count = np.asarray(self.returns, float), self.returns.size
        error = f" ± {format_number(returns.std(ddof=1) / math.sqrt(count))}" if count > 1 else ""
        length, ended = format_number(float(np.mean(self.lengths))), int(np.sum(self.terminated))
        told = f"mean return {format_number(returns.mean())}{error}, mean length {length}, {ended} ended early"
        return f"Evaluation({count} episode{'s' * (count != 1)}: {told})"


def evaluate(
    environment: Environment,
    policy: Callable[[Float[Array, " obs"]], Float[Array, " nu"]],
    key: PRNGKeyArray,
    *,
    num_episodes: int,
    engine: EngineName = QUICK,
) -> Evaluation:
    """Run a policy for whole episodes.

    Args:
        environment: the environment; its model is not randomised. Where contact lasts few time steps, take
            `environment.refined(8)` for shorter ones.
        policy: function from an observation to an action.
        key: key of the starts; consumed here.
        num_episodes: number of episodes, at least 1.
        engine: C MuJoCo with its own contact by default; "mjx" for the environment's own step.

    Raises:
        ValueError: if there are no episodes, or no such engine.
    """
    instance("environment", environment, Environment, "of mg.envs.Environment")
    function("policy", policy, "obs", is_needed=True)
    one_of("engine", engine, ENGINES)
    num_episodes = whole("num_episodes", num_episodes)
    one_key(key)
    judge = environment if ENGINES[engine].compiles else environment.with_contact(Discrete()).with_engine(engine)

    def one(key: PRNGKeyArray) -> Evaluation:
        start = judge.reset(key)

        def advance(carry: tuple[EnvState, dict[str, Array], Array], _):
            state, totals, length = carry
            with traceable("the policy"):
                action = policy(state.obs)
            stepped = judge.step(state, action)
            following = jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, stepped)
            now = stepped.metrics | {"reward": stepped.reward}
            totals = {name: total + jnp.where(state.done, 0.0, now[name]) for name, total in totals.items()}
            return (following, totals, length + ~state.done), following.physics.qpos

        zeros = dict.fromkeys([*start.metrics, "reward"], jnp.zeros_like(start.reward))
        first = (start, zeros, jnp.zeros((), jnp.int32))
        (final, totals, length), qpos = jax.lax.scan(advance, first, length=judge.episode_length)
        total = totals.pop("reward")
        terms = {name: value / length for name, value in totals.items()}
        return Evaluation(total, length, final.terminated, jnp.concatenate([start.physics.qpos[None], qpos]), terms)

    keys = jax.random.split(key, num_episodes)
    program = jax.jit(jax.vmap(one))
    # A program that calls C MuJoCo compiles fast and cannot be cached.
    return compile_once(program.lower(keys))(keys) if ENGINES[engine].compiles else program(keys)
