"""How to learn by short windows; the defaults are SHAC's, `apg` has those of analytic policy gradients."""

import dataclasses
from typing import Any

from mjxgrad.estimators.rules import Consistent, FixedAlpha, Rule


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to learn; the defaults are SHAC's.

    Attributes:
        num_environments: side by side.
        window: steps of each environment per update.
        discount: per step.
        trace: λ of the value function's targets.
        rule: from the evidence of a step and action to the weight of its first-order gradient. It is asked for every one of
            them: one that sees bias by chance in a twentieth brings in much noise, so the default is surer.
        stddev: of the noise on actions before their squashing, in the first and in the last update.
        actor_layers: hidden sizes of the policy.
        actor_scale: what the first gains of its hidden layers are multiplied with.
        critic_layers: hidden sizes of the value function.
        actor_rate: learning rate, which decreases linearly to zero.
        actor_decay: what the rate is multiplied with at every update instead, unless None.
        critic_rate: of the value function, likewise.
        critic_iterations: passes over a window's states per update.
        critic_batches: parts of such a pass.
        target_rate: share by which the target value function follows the value function.
        largest_norm: to which gradients are clipped.
        largest_sample: to which the first-order gradient of one environment's step is shortened, in root mean squares of the
            zeroth-order one over environments: at 0.3 its variance is at most a tenth of that. Infinity shortens none.
        has_critic: whether a value function stands for what comes after a window; otherwise nothing does.
        is_episodic: whether every window begins anew.
    """

    num_environments: int = 64
    window: int = 32
    discount: float = 0.99
    trace: float = 0.95
    rule: Rule = dataclasses.field(default_factory=lambda: Consistent(failure_probability=1e-3))
    stddev: tuple[float, float] = (0.4, 0.1)
    actor_layers: tuple[int, ...] = (128, 64, 32)
    actor_scale: float = 1.0
    critic_layers: tuple[int, ...] = (64, 64)
    actor_rate: float = 2e-3
    actor_decay: float | None = None
    critic_rate: float = 2e-3
    critic_iterations: int = 16
    critic_batches: int = 4
    target_rate: float = 0.8
    largest_norm: float = 1.0
    largest_sample: float = 0.3
    has_critic: bool = True
    is_episodic: bool = False

    def __post_init__(self):
        for name in ("num_environments", "window", "critic_iterations", "critic_batches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("discount", "trace", "target_rate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be from 0 to 1, got {getattr(self, name)}")
        if not self.largest_sample > 0:
            raise ValueError(f"largest_sample must be positive, got {self.largest_sample}")
        if min(self.stddev) <= 0:
            raise ValueError(f"stddev must be positive at the beginning and at the end, got {self.stddev}")
        if (self.num_environments * self.window) % self.critic_batches:
            raise ValueError(
                f"critic_batches must divide the {self.num_environments * self.window} states of an update, "
                f"got {self.critic_batches}"
            )


def apg(**changes: Any) -> Settings:
    """Return the settings of analytic policy gradients in brax, by which MuJoCo's notebook learns to trot: no value function.

    Windows follow one another. Two things are not as there. The noise, from 0.07, is not learned, but falls linearly to 0.01.
    Gradients are clipped as a whole, not number by number, and long derivatives are shortened: that stands larger rates.

    Args:
        changes: settings that are to be others.

    References:
        Freeman et al. Brax: A Differentiable Physics Engine for Large Scale Rigid Body Simulation. arXiv:2106.13281
        (`brax/training/agents/apg`).
    """
    settings = {
        "discount": 1.0,
        "rule": FixedAlpha(1.0),
        "stddev": (0.07, 0.01),
        "actor_layers": (256, 128),
        "actor_scale": 0.01,
        "actor_rate": 1e-4,
        "actor_decay": 0.997,
        "has_critic": False,
    }
    return Settings(**(settings | changes))
