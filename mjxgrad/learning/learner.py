"""SHAC and its relatives as a method of the loop: windows in all environments, a policy step, a fit of the value function.

Another learner is another file like this one: a carry with everything that an update needs, and a `Method` for it.
"""

import dataclasses
import io
import math
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from mjxgrad._arrays import is_known
from mjxgrad._text import format_number, write
from mjxgrad.batched import over_devices
from mjxgrad.envs import Environment, EnvState
from mjxgrad.learning.mixing import Halves, Products
from mjxgrad.learning.networks import FINAL_SCALE, Network, Normaliser, ValueFunction
from mjxgrad.learning.settings import Counted, Settings
from mjxgrad.learning.window import Gradients, Window, lambda_returns, window_gradients
from mjxgrad.loop.run import Method

Metrics = dict[str, Float[Array, ""]]
_CRITIC_TRACE = 0.95  # λ of the value function's targets
_TARGET_RATE = 0.8  # share by which the target value function follows the value function
_LARGEST_NORM = 1.0  # to which gradients are clipped


class Policy(eqx.Module):
    """A learned policy: a map from observations to actions.

    Attributes:
        actor: network from normalised observations to actions before squashing.
        normaliser: normalisation of observations.
    """

    actor: Network
    normaliser: Normaliser

    def __call__(self, obs: Float[Array, " obs"]) -> Float[Array, " nu"]:
        """Return the action, from −1 to 1, without noise."""
        return jnp.tanh(self.actor(self.normaliser(obs)))

    def __repr__(self) -> str:
        layers, count = self.actor.layers, self.normaliser.count
        if not all(eqx.is_array_like(one.weight) and jnp.ndim(one.weight) > 1 for one in layers):
            return super().__repr__()  # a tree of something else, such as axes of vmap
        sizes = [one.weight.shape[-1] for one in layers] + [layers[-1].weight.shape[-2]]
        seen = f", {format_number(float(np.max(count)))} observations seen" if is_known(count) else ""
        several = f", {math.prod(count.shape)} side by side" * bool(count.shape)
        return f"Policy({' → '.join(map(str, sizes))}{seen}{several})"

    @property
    def arrays(self) -> dict[str, Array]:
        """All its numbers by name: a layer is `gain * normalised(elu(weight @ x + bias)) + offset`, the last `weight @ x + bias`.

        The input is (obs − `mean`) / `scale`; `squares` over `count` is the variance that `scale` comes from.
        """
        layers, norms, seen = self.actor.layers, self.actor.norms, self.normaliser
        return {
            **{f"{k}{i}": getattr(layer, k) for i, layer in enumerate(layers) for k in ("weight", "bias")},
            **{
                f"{k}{i}": getattr(n, of)
                for i, n in enumerate(norms)
                for k, of in (("gain", "weight"), ("offset", "bias"))
            },
            **{name: getattr(seen, name) for name in ("count", "mean", "squares", "scale")},
        }

    def save(self, path: str | Path) -> None:
        """Write the `arrays` as an archive of NumPy's, an .npz, from which ten lines of NumPy run the policy; see the how-to."""
        if self.normaliser.count.ndim:
            first = "jax.tree.map(lambda x: x[0], policy) is the first"
            raise ValueError(f"policy must be one, got several side by side: {first}")
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **{name: np.asarray(x) for name, x in self.arrays.items()})
        write(path, content.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> "Policy":
        """Return the policy that `save` wrote.

        Raises:
            ValueError: if there is no such file, or it holds no policy.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                found = {name: jnp.asarray(archive[name]) for name in archive.files}
            weights = [found[f"weight{i}"] for i in range(sum(name.startswith("weight") for name in found))]
            sizes = [weights[0].shape[1], *(len(weight) for weight in weights)]
            blank = cls(Network.make(sizes, jax.random.key(0)), Normaliser.make(sizes[0]))
            numbers = [found[name] for name in blank.arrays if name != "scale"]  # in the order of the leaves
            return jax.tree.unflatten(jax.tree.structure(blank), numbers)
        except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, zipfile.BadZipFile) as error:
            what = "" if Path(path).exists() else ", which does not exist"
            raise ValueError(f"path must be of a policy that save wrote, got {path}{what}") from error


class Learner(eqx.Module):
    """The complete state between two updates.

    Attributes:
        policy: the policy, with the moments of its observations.
        normaliser: normalisation of what the value function sees, of which the policy's is the first part.
        critic: the value function.
        target: the target value function, which follows the critic and replaces it in targets and gradients.
        actor_moments: state of the policy's optimiser.
        critic_moments: state of the value function's optimiser.
        products: running products of both gradients, which decide their weights.
        environments: state of each copy of the environment.
        model_keys: key of each copy's randomised model.
        episode_return: return so far of each running episode.
        num_updates: number of updates done.
        key: key of all later draws.
    """

    policy: Policy
    normaliser: Normaliser
    critic: ValueFunction
    target: ValueFunction
    actor_moments: optax.OptState
    critic_moments: optax.OptState
    products: Products
    environments: EnvState
    model_keys: Key[Array, " environments"]
    episode_return: Float[Array, " environments"]
    num_updates: Int[Array, ""]
    key: PRNGKeyArray


class ActorCritic(Method):
    """The method of `learn`: its carry is a `Learner`, its step an update.

    Attributes:
        environment: the environment to learn in.
        settings: settings of the learner.
        num_updates: total number of updates, for schedules from the first to the last; a resumed run may have another.
    """

    environment: Environment
    settings: Counted
    num_updates: Int[Array, ""] = eqx.field(converter=jnp.asarray)

    def init(self, start: PRNGKeyArray) -> Learner:
        """Draw networks and starts."""
        actor_key, critic_key, start_key, spread_key, model_key, next_key = jax.random.split(start, 6)
        settings, count = self.settings, self.settings.num_environments
        model_keys = jax.random.split(model_key, count)
        starts = jax.vmap(lambda model_key, key: self.environment.randomised(model_key).reset(key))
        environments = starts(model_keys, jax.random.split(start_key, count))
        # Otherwise all episodes would end together, and an update would see only one part of them.
        spread = jax.random.randint(spread_key, (count,), 0, self.environment.episode_length)
        environments = eqx.tree_at(lambda e: e.num_steps, environments, spread)
        num_obs, num_seen = environments.obs.shape[-1], environments.seen.shape[-1]
        normaliser = Normaliser.make(num_seen).with_more(environments.seen)
        # Actions before squashing, near zero at first.
        sizes = num_obs, *settings.actor_layers, self.environment.num_actions
        actor = Network.make(sizes, actor_key, hidden_scale=settings.actor_scale, final_scale=FINAL_SCALE)
        critic = ValueFunction.make((num_seen, *settings.critic_layers, 1), critic_key)
        if not settings.has_critic:  # one that is zero, and is never fitted
            critic = jax.tree.map(lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else x, critic)
        actor_optimiser, critic_optimiser = optimisers(settings, self.num_updates)
        return Learner(
            policy=Policy(actor, normaliser.of_first(num_obs)),
            normaliser=normaliser,
            critic=critic,
            target=critic,
            actor_moments=actor_optimiser.init(eqx.filter(actor, eqx.is_array)),
            critic_moments=critic_optimiser.init(eqx.filter(critic.network, eqx.is_array)),
            products=Products.none(),
            environments=environments,
            model_keys=model_keys,
            episode_return=jnp.zeros(count),
            num_updates=jnp.zeros((), jnp.int32),
            key=next_key,
        )

    def step(self, carry: Learner, index: Int[Array, ""]) -> tuple[Learner, Metrics]:
        """Do one update; its metrics are described in `learn`."""
        settings, learner = self.settings, carry
        noise_key, critic_key, next_key = jax.random.split(learner.key, 3)
        first, last = settings.stddev
        stddev = first + (last - first) * learner.num_updates / self.num_updates
        window, environments, gradients = self._windows(learner, noise_key, stddev)
        improved, found = self._improve(learner, window, gradients, stddev)
        fitted, critic_loss = improved, jnp.zeros(())
        if settings.has_critic:
            fitted, critic_loss = self._fit_critic(improved, window, critic_key)
        episode_return, ended = _episodes(window, learner.episode_return)
        normaliser = learner.normaliser.with_more(window.seen)
        following = dataclasses.replace(
            fitted,
            policy=Policy(fitted.policy.actor, normaliser.of_first(environments.obs.shape[-1])),
            normaliser=normaliser,
            environments=environments,
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

    def identity(self) -> dict[str, Any]:
        name = type(self.environment).__qualname__
        return {name: repr(value) for name, value in vars(self.settings).items()} | {"environment": name}

    def learnt(self, carry: Learner) -> Policy:
        return carry.policy

    def shared(self) -> Environment:
        return self.environment

    def _windows(
        self, learner: Learner, key: PRNGKeyArray, stddev: Float[Array, ""]
    ) -> tuple[Window, EnvState, Gradients]:
        """Run a window in all environments, on all devices, and differentiate its return."""
        shape = (self.settings.num_environments, self.settings.window, self.environment.num_actions)
        noise = jax.random.normal(key, shape, learner.environments.obs.dtype)
        arrays, structure = eqx.partition(self.environment, eqx.is_array)

        def one(shared, state: EnvState, model_key: PRNGKeyArray, noise: Array):
            arrays, *others = shared
            own = eqx.combine(arrays, structure)
            how = {name: getattr(self.settings, name) for name in ("discount", "trace", "bundle")}
            return window_gradients(own, state, model_key, noise, *others, **how)

        # The environment is passed, not closed over: jax 0.11 refuses closed-over arrays of all devices inside a shard.
        shared = (arrays, learner.policy.actor, learner.target, learner.normaliser, stddev)
        return over_devices(one, num_shared=1)(shared, learner.environments, learner.model_keys, noise)

    def _improve(
        self, learner: Learner, window: Window, gradients: Gradients, stddev: Float[Array, ""]
    ) -> tuple[Learner, Metrics]:
        """Move the policy along the mixture, if that is finite."""
        policy = learner.policy
        shortened, is_shortened = gradients.shortened(self.settings.largest_sample)

        def acted(actor: Network) -> Float[Array, "environments steps nu"]:
            obs = window.seen[..., : len(policy.normaliser.mean)]
            return jax.vmap(jax.vmap(lambda obs: actor(policy.normaliser(obs))))(obs)

        before, pull_back = jax.vjp(acted, policy.actor)
        count = self.settings.num_environments
        is_first = (jnp.arange(count) < count // 2)[:, None, None]

        def halves(by_action: Float[Array, "environments steps nu"]) -> Halves:
            # Optimisers descend, so the gradient is that of the negative mean return per step.
            slope = -by_action / (count * self.settings.window)
            return pull_back(jnp.where(is_first, slope, 0))[0], pull_back(jnp.where(is_first, 0, slope))[0]

        first, zeroth = halves(shortened.sound.first), halves(shortened.zeroth)
        products = learner.products.with_more(first, zeroth)
        alpha = self.settings.alpha
        a, b = products.weights() if alpha is None else (jnp.asarray(alpha), jnp.asarray(1 - alpha))
        mixed = jax.tree.map(lambda d, z: a * d + b * z, first, zeroth)
        gradient = optax.tree.add(*mixed)
        norm = optax.tree.norm(gradient)
        is_finite = jnp.isfinite(norm)
        optimiser, _ = optimisers(self.settings, self.num_updates)
        old = (policy.actor, learner.actor_moments)
        steps, moments = optimiser.update(gradient, learner.actor_moments)
        after = acted(eqx.apply_updates(policy.actor, steps))
        # Nats of relative entropy, which grow with the square of a step.
        change = ((after - before) ** 2).sum(axis=-1).mean() / (2 * stddev**2)
        share = jnp.minimum(1.0, jnp.sqrt(self.settings.largest_change / change))
        new = (eqx.apply_updates(policy.actor, jax.tree.map(lambda step: share * step, steps)), moments)
        actor, moments = jax.tree.map(lambda x, y: jnp.where(is_finite, x, y), new, old)
        found = {
            "alpha": a / jnp.where(a + b > 0, a + b, 1.0),
            "gradient_norm": norm,
            "agreement": optax.tree.vdot(*mixed) / math.prod(map(optax.tree.norm, mixed)),
            "cosine": products.cosine,
            "first_variance": optax.tree.norm(optax.tree.sub(*first), squared=True),
            "zeroth_variance": optax.tree.norm(optax.tree.sub(*zeroth), squared=True),
            "not_finite": (~gradients.is_finite).mean(),
            "shortened": is_shortened.mean(),
            "skipped": (~is_finite).astype(norm.dtype),
            "change": change,
        }
        moved = {"policy": Policy(actor, policy.normaliser), "actor_moments": moments, "products": products}
        return dataclasses.replace(learner, **moved), found

    def _fit_critic(self, learner: Learner, window: Window, key: PRNGKeyArray) -> tuple[Learner, Float[Array, ""]]:
        """Fit value function and target to the window's returns; return the loss of the last pass, too."""
        normaliser = learner.normaliser
        value, how = lambda seen: learner.target(normaliser(seen)), (self.settings.discount, _CRITIC_TRACE)
        wanted = jax.vmap(lambda one: lambda_returns(one, value, *how))(window).reshape(-1)
        critic, target = learner.critic.with_more(wanted), learner.target.with_more(wanted)
        seen = normaliser(window.seen.reshape(len(wanted), -1))
        _, optimiser = optimisers(self.settings, self.num_updates)

        def loss(network: Network, seen: Array, wanted: Array) -> Float[Array, ""]:
            return ValueFunction(network, critic.moments).loss(seen, wanted)

        def fit(carry: tuple[Network, optax.OptState], rows: Array):
            network, moments = carry
            value, gradient = jax.value_and_grad(loss)(network, seen[rows], wanted[rows])
            return _stepped(optimiser, gradient, moments, network), value

        keys = jax.random.split(key, self.settings.critic_iterations)
        orders = jax.vmap(lambda k: jax.random.permutation(k, len(wanted)))(keys)
        rows = orders.reshape(self.settings.critic_iterations * self.settings.critic_batches, -1)
        (network, moments), losses = jax.lax.scan(fit, (critic.network, learner.critic_moments), rows)
        critic = ValueFunction(network, critic.moments)
        target = jax.tree.map(lambda old, new: old + _TARGET_RATE * (new - old), target, critic)
        fitted = dataclasses.replace(learner, critic=critic, target=target, critic_moments=moments)
        return fitted, losses[-self.settings.critic_batches :].mean()


def optimisers(
    settings: Settings, num_updates: int | Int[Array, ""]
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Return the optimisers of the policy and of the value function."""

    def optimiser(schedule: optax.Schedule) -> optax.GradientTransformation:
        clip = optax.clip_by_global_norm(_LARGEST_NORM)
        # Flattened to one vector, which takes a few operations instead of as many for each layer's arrays.
        return optax.flatten(optax.chain(clip, optax.adam(schedule, b1=0.7, b2=0.95)))

    def falling(rate: float, num_steps: int | Int[Array, ""]) -> optax.Schedule:
        return lambda count: rate * jnp.maximum(1 - count / num_steps, 0)

    per_update = settings.critic_iterations * settings.critic_batches
    actor_rate = falling(settings.actor_rate, num_updates)
    if settings.actor_decay is not None:
        actor_rate = optax.exponential_decay(settings.actor_rate, 1, settings.actor_decay)
    critic_rate = falling(settings.critic_rate, num_updates * per_update)
    return optimiser(actor_rate), optimiser(critic_rate)


def _stepped(
    optimiser: optax.GradientTransformation, gradient: Any, moments: optax.OptState, network: Network
) -> tuple[Network, optax.OptState]:
    changes, moments = optimiser.update(gradient, moments)
    return eqx.apply_updates(network, changes), moments


def _episodes(window: Window, so_far: Float[Array, " environments"]) -> tuple[Float[Array, " environments"], Metrics]:
    """Return the running episodes' returns so far, and the mean return of those that ended, NaN without any."""

    def add(total: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, is_over = now
        total = total + reward
        return jnp.where(is_over, 0.0, total), jnp.where(is_over, total, 0.0)

    so_far, whole = jax.lax.scan(add, so_far, (window.rewards.T, window.done.T))
    num_ended = window.done.sum()
    return so_far, {"return": jnp.where(num_ended > 0, whole.sum() / jnp.maximum(num_ended, 1), jnp.nan)}
