"""PPO by brax: what a policy learns from as many steps without any derivative of the physics."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.config import ExperimentError
from mjxgrad.envs import Environment

_READINGS = 20
_MINIBATCHES = 4

Act = Callable[[Any, Float[Array, " obs"]], Float[Array, " nu"]]
"""From what was learned and what is seen to an action."""


def learn_ppo(
    environment: Environment,
    seed: int,
    *,
    num_steps: int,
    num_environments: int,
    window: int,
    report: Callable[[int], None],
) -> tuple[Any, Act, dict[str, Float[np.ndarray, " readings"]]]:
    """Learn a policy from so many steps.

    The numbers are DiffRL's for PPO, but for batches of 8192 steps, since theirs are for eighty times as many in all.

    Returns:
        What was learned, how to act by it without noise, and by name: `steps` and `seconds` until a reading, compilation left
        out, and `reward`, the mean per step of whole episodes then.
    """
    ppo, networks, environment_of_brax = load()
    # Whole episodes to read a reward from: fewer where they would take longer than learning does.
    num_readings = min(_READINGS, max(2, num_steps // (4 * num_environments * environment.episode_length)))
    readings: list[tuple[float, float, float]] = []

    def note(steps: int, metrics: dict[str, Any]) -> None:
        reward = metrics["eval/episode_reward"] / metrics["eval/avg_episode_length"]
        readings.append((steps, metrics.get("training/walltime", 0.0), float(reward)))
        report(min(steps, num_steps))

    make_policy, params, _ = ppo.train(
        environment_of_brax(environment),
        num_timesteps=num_steps,
        episode_length=environment.episode_length,
        num_envs=num_environments,
        unroll_length=window,
        batch_size=num_environments // _MINIBATCHES,
        num_minibatches=_MINIBATCHES,
        num_updates_per_batch=5,
        learning_rate=1e-3,
        discounting=0.99,
        gae_lambda=0.95,
        clipping_epsilon=0.2,
        entropy_cost=0.0,
        max_grad_norm=1.0,
        reward_scaling=0.01,
        normalize_observations=True,
        network_factory=functools.partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=(128, 64, 32), value_hidden_layer_sizes=(256, 256)
        ),
        num_evals=num_readings + 1,
        num_eval_envs=64,
        deterministic_eval=True,
        progress_fn=note,
        seed=seed,
    )
    steps, walls, reward = np.array(readings).T
    # Brax counts compilation in with the first part, and often with the second.
    parts = np.diff(walls)
    parts[:2] = np.median(parts[min(2, len(parts) - 1) :])
    seconds = np.concatenate([[0.0], parts.cumsum()])

    def act(params: Any, obs: Float[Array, " obs"]) -> Float[Array, " nu"]:
        return make_policy(params, deterministic=True)(obs, jax.random.key(0))[0]

    return params, act, {"steps": steps, "seconds": seconds, "reward": reward}


def load() -> tuple[Any, Any, Any]:
    """Return brax's learner, its networks, and our environments for it; an `ExperimentError` without brax."""
    if not hasattr(jax, "device_put_replicated"):
        # Removed in jax 0.10; the last release of brax, 0.14.2, calls it.
        setattr(jax, "device_put_replicated", _replicated)  # noqa: B010
    try:
        from brax.training.agents.ppo import networks, train  # pyright: ignore[reportMissingImports]

        from mjxgrad.envs.brax import BraxEnv
    except ImportError as error:
        raise ExperimentError("the method ppo needs brax: pip install 'mjxgrad[playground]'") from error
    return train, networks, BraxEnv


def _replicated(tree: Any, devices: list[jax.Device]) -> Any:
    return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
