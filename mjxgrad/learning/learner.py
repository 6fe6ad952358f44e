"""What learns and how: settings, a policy, and all that an update needs to know."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from mjxgrad.envs import Environment, EnvState
from mjxgrad.estimators.rules import Consistent, FixedAlpha, Rule
from mjxgrad.learning.networks import Network, Normaliser, make_actor, make_critic


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


class Policy(eqx.Module):
    """A learned policy: what it does for what it sees.

    Attributes:
        actor: from normalised observations to actions before their squashing.
        normaliser: of observations.
    """

    actor: Network
    normaliser: Normaliser

    def __call__(self, obs: Float[Array, " obs"]) -> Float[Array, " nu"]:
        """Return the action, from −1 to 1, without noise."""
        return jnp.tanh(self.actor(self.normaliser(obs)))


class Learner(eqx.Module):
    """All that an update needs: to go on from a `Learner` is to have never stopped.

    Attributes:
        policy: with the moments of what it has seen.
        critic: the value function.
        target: that follows it, and is used in its place in targets and gradients.
        actor_moments: of the optimiser.
        critic_moments: likewise.
        environments: where they are, one per copy.
        model_keys: by which the copies' models differ.
        episode_return: so far, of the episodes that run.
        num_updates: done.
        key: for what is drawn later.
    """

    policy: Policy
    critic: Network
    target: Network
    actor_moments: optax.OptState
    critic_moments: optax.OptState
    environments: EnvState
    model_keys: Key[Array, " environments"]
    episode_return: Float[Array, " environments"]
    num_updates: Int[Array, ""]
    key: PRNGKeyArray


def begin(environment: Environment, key: PRNGKeyArray, *, settings: Settings, num_updates: int) -> Learner:
    """Draw networks and starts."""
    actor_key, critic_key, start_key, spread_key, model_key, next_key = jax.random.split(key, 6)
    count = settings.num_environments
    model_keys = jax.random.split(model_key, count)
    environments = starts(environment, model_keys, start_key)
    if not settings.is_episodic:
        # Otherwise all episodes would end together, and an update see only one part of them.
        spread = jax.random.randint(spread_key, (count,), 0, environment.episode_length)
        environments = eqx.tree_at(lambda e: e.num_steps, environments, spread)
    num_observations = environments.obs.shape[-1]
    actor = make_actor(
        num_observations, environment.num_actions, settings.actor_layers, actor_key, settings.actor_scale
    )
    # Without a value function it is one that is zero and stays so.
    scale = 1.0 if settings.has_critic else 0.0
    critic = make_critic(num_observations, settings.critic_layers, critic_key, final_scale=scale)
    actor_optimiser, critic_optimiser = optimisers(settings, num_updates)
    return Learner(
        policy=Policy(actor, Normaliser.make(num_observations).with_more(environments.obs)),
        critic=critic,
        target=critic,
        actor_moments=actor_optimiser.init(eqx.filter(actor, eqx.is_array)),
        critic_moments=critic_optimiser.init(eqx.filter(critic, eqx.is_array)),
        environments=environments,
        model_keys=model_keys,
        episode_return=jnp.zeros(count),
        num_updates=jnp.zeros((), jnp.int32),
        key=next_key,
    )


def starts(environment: Environment, model_keys: Key[Array, " environments"], key: PRNGKeyArray) -> EnvState:
    """Begin an episode in each copy."""

    def start(model_key: PRNGKeyArray, key: PRNGKeyArray) -> EnvState:
        return environment.randomised(model_key).reset(key)

    return jax.vmap(start)(model_keys, jax.random.split(key, len(model_keys)))


def optimisers(
    settings: Settings, num_updates: int
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Return those of policy and value function."""

    def optimiser(schedule: optax.Schedule) -> optax.GradientTransformation:
        clip = optax.clip_by_global_norm(settings.largest_norm)
        # Of one vector it is a few operations, of each layer's arrays as many each.
        return optax.flatten(optax.chain(clip, optax.adam(schedule, b1=0.7, b2=0.95)))

    per_update = settings.critic_iterations * settings.critic_batches
    actor_rate = optax.linear_schedule(settings.actor_rate, 0.0, num_updates)
    if settings.actor_decay is not None:
        actor_rate = optax.exponential_decay(settings.actor_rate, 1, settings.actor_decay)
    critic_rate = optax.linear_schedule(settings.critic_rate, 0.0, num_updates * per_update)
    return optimiser(actor_rate), optimiser(critic_rate)
