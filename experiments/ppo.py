"""PPO by brax: what a policy learns from as many steps without any derivative of the physics."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.config import ExperimentError
from mjxgrad.envs import Environment

_READINGS = 20
# Brax's own numbers for its half_cheetah with a longer discount, with which ants learn three times as much as with its ant's;
# hoppers' and walkers' are those of MuJoCo Playground for dm_control, quadrupeds' and the tracking humanoid's those for its
# Go1 and G1.
_HOW = {
    "num_envs": 2048,
    "unroll_length": 20,
    "batch_size": 512,
    "num_minibatches": 32,
    "num_updates_per_batch": 8,
    "learning_rate": 3e-4,
    "discounting": 0.99,
    "entropy_cost": 1e-3,
    "reward_scaling": 1.0,
}
_OWN: dict[str, dict[str, Any]] = {
    "half_cheetah": {"discounting": 0.95},
    "humanoid": {"unroll_length": 10, "batch_size": 1024, "discounting": 0.97, "reward_scaling": 0.1},
    "hopper": {"unroll_length": 30, "batch_size": 1024, "num_updates_per_batch": 16, "learning_rate": 1e-3}
    | {"discounting": 0.995, "entropy_cost": 1e-2, "reward_scaling": 10.0},
    "quadruped": {"num_envs": 8192, "batch_size": 256, "num_updates_per_batch": 4, "discounting": 0.97}
    | {"entropy_cost": 1e-2, "max_grad_norm": 1.0},
}
_OWN |= {"walker2d": _OWN["hopper"], "go1": _OWN["quadruped"], "tracking": _OWN["quadruped"] | {"entropy_cost": 5e-3}}
_WIDE = dict.fromkeys(["policy_hidden_layer_sizes", "value_hidden_layer_sizes"], (512, 256, 128))
_LAYERS = {"quadruped": _WIDE, "go1": _WIDE, "tracking": _WIDE}

Act = Callable[[Any, Float[Array, " obs"]], Float[Array, " nu"]]
"""From what was learned and what is seen to an action."""


def learn_ppo(
    name: str, environment: Environment, seed: int, *, num_steps: int, report: Callable[[int], None]
) -> tuple[Any, Act, dict[str, Float[np.ndarray, " readings"]]]:
    """Learn a policy from so many steps, or as many as fill a batch, with brax's numbers for a robot of that name.

    With what was learned goes how to act by it without noise, and by name: `steps` and `seconds` until a reading, compilation
    left out, and `reward`, the mean per step of whole episodes then.
    """
    ppo, networks, environment_of_brax = load()
    how = numbers_of(name)
    # A part between two readings has a batch at least.
    num_batches = num_steps // math.prod(how[each] for each in ("batch_size", "num_minibatches", "unroll_length"))
    readings: list[tuple[float, float, float]] = []

    def note(steps: int, metrics: dict[str, Any]) -> None:
        reward = metrics["eval/episode_reward"] / metrics["eval/avg_episode_length"]
        readings.append((steps, metrics.get("training/walltime", 0.0), float(reward)))
        report(min(steps, num_steps))

    make_policy, params, _ = ppo.train(
        environment_of_brax(environment),
        num_timesteps=num_steps,
        episode_length=environment.episode_length,
        normalize_observations=True,
        network_factory=functools.partial(networks.make_ppo_networks, **_LAYERS.get(name, {})),
        num_evals=1 + min(_READINGS, max(1, num_batches)),
        num_eval_envs=64,
        deterministic_eval=True,
        progress_fn=note,
        seed=seed,
        **how,
    )
    steps, walls, reward = np.array(readings).T
    # Brax counts compilation in with the first part, and often with the second.
    parts = np.diff(walls)
    parts[:2] = np.median(parts[min(2, len(parts) - 1) :])
    seconds = np.concatenate([[0.0], parts.cumsum()])

    def act(params: Any, obs: Float[Array, " obs"]) -> Float[Array, " nu"]:
        return make_policy(params, deterministic=True)(obs, jax.random.key(0))[0]

    return params, act, {"steps": steps, "seconds": seconds, "reward": reward}


def numbers_of(name: str) -> dict[str, Any]:
    """Return PPO's numbers for a robot; gymnasium's (`_v5`) have those of their kind."""
    return _HOW | _OWN.get(name.removesuffix("_v5"), {})


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
