"""Policies in gymnasium's own robots, by its Runge-Kutta steps: what a return there is worth to anyone who knows these robots."""

from collections.abc import Callable

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Ours neither see nor charge contact forces, and see no inertias: gymnasium's own options.
_UNSEEN = dict.fromkeys(("cinert", "cvel", "qfrc_actuator", "cfrc_ext"), False)
_OPTIONS = {
    "ant": {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0},
    "humanoid": {f"include_{k}_in_observation": v for k, v in _UNSEEN.items()} | {"contact_cost_weight": 0},
}


def own_robot(name: str) -> gymnasium.Env:
    """Return gymnasium's robot of version 5; `name` is one of `mjxgrad.envs.ENVIRONMENTS`."""
    title = "".join(word.capitalize() for word in name.split("_"))
    return gymnasium.make(f"{title}-v5", **_OPTIONS.get(name, {}))


def gymnasium_returns(
    name: str, act: Callable[[Float[Array, " obs"]], Float[Array, " nu"]], *, num_episodes: int
) -> Float[np.ndarray, " episodes"]:
    """Run a policy without noise in gymnasium's robot of that name."""
    robot, decide = own_robot(name), jax.jit(act)
    largest, returns = robot.action_space.high, np.zeros(num_episodes)  # pyright: ignore[reportAttributeAccessIssue]
    for episode in range(num_episodes):
        obs, _ = robot.reset(seed=episode)
        is_over = False
        while not is_over:
            action = largest * np.asarray(decide(jnp.asarray(obs, jnp.float32)))
            obs, reward, terminated, truncated, _ = robot.step(action.astype(np.float32))
            returns[episode] += reward
            is_over = terminated or truncated
    robot.close()
    return returns
