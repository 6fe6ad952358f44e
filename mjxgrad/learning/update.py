"""One update: a window in every environment, a step of the policy, a fit of the value function."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.batched import over_devices
from mjxgrad.envs import Environment, EnvState
from mjxgrad.learning.learner import Learner, Policy, Settings, optimisers, starts
from mjxgrad.learning.networks import Network
from mjxgrad.learning.window import Gradients, Window, lambda_returns, mix, window_gradients

Metrics = dict[str, Float[Array, ""]]


def update(
    environment: Environment, learner: Learner, *, settings: Settings, num_updates: int
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """Do one update; traceable.

    Returns:
        The learner after it, and what it found, see `learn`.
    """
    noise_key, start_key, critic_key, next_key = jax.random.split(learner.key, 4)
    first, last = settings.stddev
    stddev = first + (last - first) * learner.num_updates / num_updates
    environments = learner.environments
    if settings.is_episodic:
        environments = starts(environment, learner.model_keys, start_key)
    window, environments, gradients = _windows(environment, learner, environments, noise_key, stddev, settings)
    policy, actor_moments, found = _improve(learner, window, gradients, settings, num_updates)
    critic, target, critic_moments, critic_loss = learner.critic, learner.target, learner.critic_moments, jnp.zeros(())
    if settings.has_critic:
        critic, critic_moments, critic_loss = _fit_critic(learner, window, critic_key, settings, num_updates)
        target = jax.tree.map(lambda old, new: old + settings.target_rate * (new - old), learner.target, critic)
    so_far = jnp.zeros_like(learner.episode_return) if settings.is_episodic else learner.episode_return
    episode_return, ended = _episodes(window, so_far)
    following = Learner(
        policy=eqx.tree_at(lambda p: p.normaliser, policy, learner.policy.normaliser.with_more(window.obs)),
        critic=critic,
        target=target,
        actor_moments=actor_moments,
        critic_moments=critic_moments,
        environments=environments,
        model_keys=learner.model_keys,
        episode_return=episode_return,
        num_updates=learner.num_updates + 1,
        key=next_key,
    )
    facts = {
        "reward": window.rewards.mean(),
        "ended": window.terminated.any(axis=1).mean(),
        "diverged": window.metrics["diverged"].sum(),
        "critic_loss": critic_loss,
    }
    return following, {**facts, **ended, **found}


def _windows(
    environment: Environment,
    learner: Learner,
    environments: EnvState,
    key: PRNGKeyArray,
    stddev: Float[Array, ""],
    settings: Settings,
) -> tuple[Window, EnvState, Gradients]:
    """Run a window everywhere, on all devices, and differentiate what it returns."""
    shape = (settings.num_environments, settings.window, environment.num_actions)
    noise = jax.random.normal(key, shape, environments.obs.dtype)

    arrays, structure = eqx.partition(environment, eqx.is_array)

    def one(shared, state: EnvState, model_key: PRNGKeyArray, noise: Array):
        arrays, policy, critic, stddev = shared
        own = eqx.combine(arrays, structure)
        return window_gradients(
            own, state, model_key, noise, policy.actor, critic, policy.normaliser, stddev, settings.discount
        )

    # The environment is one of them: closed over, arrays of all devices are refused where each has its part (jax 0.11).
    shared = (arrays, learner.policy, learner.target, stddev)
    return over_devices(one, num_shared=1)(shared, environments, learner.model_keys, noise)


def _improve(
    learner: Learner, window: Window, gradients: Gradients, settings: Settings, num_updates: int
) -> tuple[Policy, optax.OptState, Metrics]:
    """Move the policy along the mixture, unless that is not finite; and say what it was made of."""
    policy = learner.policy
    gradients, is_shortened = gradients.shortened(settings.largest_sample)
    mixture, weights, evidence = mix(gradients, settings.rule)

    def acted(actor: Network) -> Float[Array, "environments steps nu"]:
        return jax.vmap(jax.vmap(lambda obs: actor(policy.normaliser(obs))))(window.obs)

    _, pull_back = jax.vjp(acted, policy.actor)
    # Down the negative mean return per step, as optimisers take it.
    (gradient,) = pull_back(-mixture / (settings.num_environments * settings.window))
    norm = optax.tree.norm(gradient)
    is_finite = jnp.isfinite(norm)
    optimiser, _ = optimisers(settings, num_updates)
    new = _stepped(optimiser, gradient, learner.actor_moments, policy.actor)
    actor, moments = jax.tree.map(lambda x, y: jnp.where(is_finite, x, y), new, (policy.actor, learner.actor_moments))
    found = {
        "alpha": weights.alpha.mean(),
        "gradient_norm": norm,
        "first_variance": evidence.first_variance.sum(),
        "zeroth_variance": evidence.zeroth_variance.sum(),
        "squared_bias": (evidence.difference_norm**2 - evidence.difference_variance / evidence.real_count).sum(),
        "not_finite": (~gradients.is_finite).mean(),
        "shortened": is_shortened.mean(),
        "skipped": (~is_finite).astype(norm.dtype),
    }
    return Policy(actor, policy.normaliser), moments, found


def _fit_critic(
    learner: Learner, window: Window, key: PRNGKeyArray, settings: Settings, num_updates: int
) -> tuple[Network, optax.OptState, Float[Array, ""]]:
    """Fit the value function to the window's targets, in batches of shuffled states."""
    normaliser = learner.policy.normaliser

    def targets(window: Window) -> Float[Array, " steps"]:
        return lambda_returns(window, lambda obs: learner.target(normaliser(obs))[0], settings.discount, settings.trace)

    wanted = jax.vmap(targets)(window).reshape(-1)
    seen = jax.vmap(normaliser)(window.obs.reshape(len(wanted), -1))
    _, optimiser = optimisers(settings, num_updates)

    def loss(critic: Network, seen: Array, wanted: Array) -> Float[Array, ""]:
        return ((jax.vmap(critic)(seen)[:, 0] - wanted) ** 2).mean()

    def fit(carry: tuple[Network, optax.OptState], rows: Array):
        critic, moments = carry
        value, gradient = jax.value_and_grad(loss)(critic, seen[rows], wanted[rows])
        return _stepped(optimiser, gradient, moments, critic), value

    orders = jax.vmap(lambda k: jax.random.permutation(k, len(wanted)))(
        jax.random.split(key, settings.critic_iterations)
    )
    rows = orders.reshape(settings.critic_iterations * settings.critic_batches, -1)
    (critic, moments), losses = jax.lax.scan(fit, (learner.critic, learner.critic_moments), rows)
    return critic, moments, losses[-settings.critic_batches :].mean()


def _stepped(
    optimiser: optax.GradientTransformation, gradient: Any, moments: optax.OptState, network: Network
) -> tuple[Network, optax.OptState]:
    changes, moments = optimiser.update(gradient, moments)
    return eqx.apply_updates(network, changes), moments


def _episodes(window: Window, so_far: Float[Array, " environments"]) -> tuple[Float[Array, " environments"], Metrics]:
    """Return what running episodes have returned so far, and the mean of those that ended, NaN if none did."""

    def add(total: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, is_over = now
        total = total + reward
        return jnp.where(is_over, 0.0, total), jnp.where(is_over, total, 0.0)

    so_far, whole = jax.lax.scan(add, so_far, (window.rewards.T, window.done.T))
    num_ended = window.done.sum()
    return so_far, {"return": jnp.where(num_ended > 0, whole.sum() / jnp.maximum(num_ended, 1), jnp.nan)}
