r"""One short window in all environments, and two gradients of its return by the action of every step.

A window of $H$ steps under the policy $u_t = \mu_\theta(o_t) + \sigma w_t$, action $\tanh u_t$, has the return
$J = \sum_{t<H} \gamma^t r_t + \gamma^H V(o_H)$. Where an episode ends within the window, the sum starts anew; if only its
time was up, $V$ of its last observation is added first. There are two gradients by $u_t$:

- first order, $\lambda_t = dJ/du_t$ through physics, policy and value function, by one reverse pass;
- zeroth order, $z_t = \gamma^t A_t\, w_t/\sigma$ with the advantage $A_t = \sum_{k \ge t} \gamma^{k-t} r_k + \ldots - V(o_t)$.

**The blended adjoint.** A derivative through $H$ steps grows with every contact, and does not see that an episode may end.
Both can be had from a value function: the policy climbs the TD($\lambda$) return of every step,
$G_t = r_t + \gamma((1 - \lambda) V(o_{t+1}) + \lambda G_{t+1})$, in place of the sum of rewards. Its gradient takes one reverse
pass, too. Going backward, the adjoint $p$ of the state between two steps is replaced by
$\lambda p + (1 - \lambda) \gamma^t \nabla V$, so that derivatives reach $1/(1 - \gamma\lambda)$ steps. With
$\lambda = 1$ it is that of $J$; with $\lambda = 0$ that of one step. In zeroth order $A_t$ is $G_t - V(o_t)$.

The mean of the second is the gradient of $J$; so is the mean of the first where nothing jumps. One pull-back takes either to
the parameters, $\sum_t (\partial\mu_\theta/\partial\theta)^\top g_t$ at the recorded observations. A derivative that is not
finite is therefore found where it arises, and zeroth order takes its place. `mixing` says how both are mixed.

References:
    Those of `learn`: Xu et al. for the window. Hafner, Lillicrap, Ba, Norouzi. Dream to
    Control. ICLR 2020, arXiv:1912.01603, for the objective of the blended adjoint.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from mjxgrad.envs import Environment, EnvState
from mjxgrad.learning.networks import Network, Normaliser
from mjxgrad.learning.settings import Bundle

Value = Callable[[Float[Array, " seen"]], Float[Array, ""]]


class Window(eqx.Module):
    """The steps of one environment, or a single step without the axis; under `jax.vmap` fields gain leading axes."""

    seen: Float[Array, "*steps seen"]  # observation in which an action was chosen, and what is privileged behind it
    next_seen: Float[Array, "*steps seen"]  # the same after the action, before any reset
    rewards: Float[Array, "*steps"]
    terminated: Bool[Array, "*steps"]  # whether the episode ended for good
    truncated: Bool[Array, "*steps"]  # whether its time was up
    metrics: dict[str, Float[Array, "*steps"]]  # the terms of the rewards, and `diverged`

    def next_values(self, value: Value) -> Float[Array, " steps"]:
        """Return the values after each step; zero after an episode that ended for good."""
        return jnp.where(self.terminated, 0.0, jax.vmap(value)(self.next_seen))

    @property
    def done(self) -> Bool[Array, "*steps"]:
        return self.terminated | self.truncated


class Gradients(eqx.Module):
    """Both gradients of a window's return by step and action before squashing; under `jax.vmap` fields gain leading axes."""

    first: Float[Array, "*environments steps nu"]
    zeroth: Float[Array, "*environments steps nu"]
    is_finite: Bool[Array, "*environments steps"]  # whether the first-order gradient of all actions of a step is

    @property
    def sound(self) -> "Gradients":
        """These gradients, with zeroth order in place of a first order that is not finite."""
        return dataclasses.replace(self, first=jnp.where(self.is_finite[..., None], self.first, self.zeroth))

    def shortened(self, most: float) -> tuple["Gradients", Bool[Array, "environments steps"]]:
        """Return first-order gradients of at most `most` zeroth-order root mean squares, and which were shortened.

        Through contact a few gradients are a million times longer than the others and dominate the mean of any batch.
        Shortening adds a small bias, which the rules can see.
        """
        norms = jnp.linalg.norm(self.first, axis=-1)
        limit = most * jnp.sqrt((self.zeroth**2).sum(axis=-1).mean(axis=0))
        is_long = self.is_finite & (norms > limit)
        scale = jnp.where(is_long, limit / jnp.where(is_long, norms, 1.0), 1.0)
        return dataclasses.replace(self, first=scale[..., None] * self.first), is_long


def returned(window: Window, value: Value, discount: float, trace: float = 1.0) -> Float[Array, ""]:
    r"""Return the return $J$ of a window; with a trace below 1, that whose derivative is the blended one.

    The values of states between two steps enter by $1 - \lambda$; `run_window` multiplies their adjoints by $\lambda$.
    """
    share = jnp.where(window.done.at[-1].set(True), 1.0, 1 - trace)
    after = discount * share * window.next_values(value)
    return (weights_in_return(window, discount) * (window.rewards + after)).sum()


def lambda_returns(window: Window, value: Value, discount: float, trace: float) -> Float[Array, " steps"]:
    r"""Return the TD($\lambda$) targets of the values, $G_t = r_t + \gamma((1 - \lambda)V_{t+1} + \lambda G_{t+1})$.

    With $\lambda = 1$ they are the discounted sums of rewards to the end of the window.

    References:
        Sutton, Barto. Reinforcement Learning: An Introduction, 2nd edition, 2018, equation 12.20.
    """
    following = window.next_values(value)
    is_last = window.done.at[-1].set(True)

    def add(later: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, after, is_over = now
        target = reward + discount * jnp.where(is_over, after, (1 - trace) * after + trace * later)
        return target, target

    zero = jnp.zeros((), window.rewards.dtype)
    return jax.lax.scan(add, zero, (window.rewards, following, is_last), reverse=True)[1]


def weights_in_return(window: Window, discount: float) -> Float[Array, " steps"]:
    r"""Return $\gamma^t$ of each step, counted from the window's start or the last reset."""
    one = jnp.ones((), window.rewards.dtype)

    def count(weight: Array, is_over: Array) -> tuple[Array, Array]:
        return jnp.where(is_over, 1.0, discount * weight), weight

    return jax.lax.scan(count, one, window.done)[1]


def run_window(
    environment: Environment,
    state: EnvState,
    actor: Network,
    normaliser: Normaliser,
    noise: Float[Array, "steps nu"],
    trace: float = 1.0,
    bundle: Bundle | None = None,
) -> tuple[Window, EnvState]:
    """Run a policy for one step per row of noise, which is added to actions before squashing.

    The next window starts from the returned state. Adjoints of states between two steps are multiplied by the trace.
    """

    def advance(state: EnvState, added: Array) -> tuple[EnvState, Window]:
        action = jnp.tanh(actor(normaliser.of_first(state.obs.size)(state.obs)) + added)
        step_on = environment.step_on if bundle is None else functools.partial(bundle.step_on, environment)
        stepped, following = step_on(state, action)
        ends = (stepped.terminated, stepped.truncated)
        if trace != 1:
            following = _faded(following, trace)
        return following, Window(state.seen, stepped.seen, stepped.reward, *ends, stepped.metrics)

    final, window = jax.lax.scan(advance, state, noise)
    return window, final


def _faded(state: PyTree, share: float) -> PyTree:
    """Return the state unchanged, to the bit, with its derivative multiplied by a share."""

    def fade(x: Any) -> Any:
        if not eqx.is_inexact_array(x):
            return x
        # Infinity less infinity is no number, and a memory may hold infinities.
        return x + jnp.where(jnp.isfinite(x), (share - 1) * (x - jax.lax.stop_gradient(x)), 0)

    return jax.tree.map(fade, state)


def window_gradients(
    environment: Environment,
    state: EnvState,
    model_key: PRNGKeyArray,
    noise: Float[Array, "steps nu"],
    actor: Network,
    critic: Value,
    normaliser: Normaliser,
    stddev: Float[Array, ""],
    discount: float,
    trace: float = 1.0,
    bundle: Bundle | None = None,
) -> tuple[Window, EnvState, Gradients]:
    """Run a window in one environment and differentiate its return; under `jax.vmap`, in many.

    The environment is that before `model_key` randomises it. The noise is standard normal; `stddev` is its standard
    deviation on actions before squashing.
    """
    copy = environment.randomised(model_key)

    def value(seen: Float[Array, " seen"]) -> Float[Array, ""]:
        return critic(normaliser(seen))

    def gain(change: Float[Array, "steps nu"]):
        window, final = run_window(copy, state, actor, normaliser, stddev * noise + change, trace, bundle)
        return returned(window, value, discount, trace), (window, final)

    first, (window, final) = jax.grad(gain, has_aux=True)(jnp.zeros_like(noise))
    advantages = lambda_returns(window, value, discount, trace) - jax.vmap(value)(window.seen)
    zeroth = (weights_in_return(window, discount) * advantages)[:, None] * noise / stddev
    return window, final, Gradients(first, zeroth, jnp.isfinite(first).all(axis=1))
