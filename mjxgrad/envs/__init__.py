"""Environments for learning policies: known tasks, your own, and adapters to other programs."""

from collections.abc import Callable

from mjxgrad.envs import diffrl, playground
from mjxgrad.envs.environment import Environment, EnvState
from mjxgrad.envs.gymnasium_robots import ant, half_cheetah, hopper, humanoid, walker2d

ENVIRONMENTS: dict[str, Callable[[], Environment]] = {
    **{make.__name__: make for make in (ant, half_cheetah, hopper, humanoid, walker2d)},
    **{f"diffrl_{name}": getattr(diffrl, name) for name in ("ant", "cartpole", "half_cheetah", "hopper", "humanoid")},
}

__all__ = [
    "ENVIRONMENTS", "EnvState", "Environment", "ant", "diffrl", "half_cheetah", "hopper", "humanoid", "load", "playground",
    "walker2d",
]  # fmt: skip


def load(name: str) -> Environment:
    """Return an environment by its name, one of `ENVIRONMENTS`.

    Raises:
        ValueError: if there is no such environment; the message lists them.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(f"name must be one of {', '.join(ENVIRONMENTS)}, got {name!r}")
    return ENVIRONMENTS[name]()
