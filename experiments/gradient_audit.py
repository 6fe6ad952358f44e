"""Do gradients of a frozen policy point where its return rises? `make gradient_audit`.

A policy learns for a while and is frozen. Each kind of gradient then names a direction in the space of its parameters:

- the cosines between the direction that a batch of windows finds and a reference, the mean of the unit directions that all
  kinds find in other windows;
- the slope, what a long return gains along the direction that all windows find: by central differences in MuJoCo's own
  motion with the same noise on both sides, per unit of root-mean-square change of the actions.

A second table says who misleads, contact or the value function: the cosine of first with zeroth order, with the value
function, and of the window's rewards alone.
"""

import dataclasses
import itertools
import math
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

import mjxgrad as mg
from experiments.benchmarks import announce
from experiments.learning import stiffer
from experiments.words import quantity
from mjxgrad import envs, learning
from mjxgrad.envs import Environment
from mjxgrad.learning.settings import Counted
from mjxgrad.learning.window import (
    Gradients,
    Window,
    lambda_returns,
    returned,
    run_window,
    weights_in_return,
    window_gradients,
)
from mjxgrad.stepping import Contact

_KINDS = {"own": mg.Discrete(), "slope": mg.Slope(), "onset": mg.Onset()}
_LIMITS = (0.3, 0.1)
_MIXED = 96  # actions by which copies of a state are driven apart
_LONG = 192  # actions of the long return, which the value function ends
_WIDTH = 0.05  # rms change of the actions, of the central differences
_MOST_BATCHES = 32
_PARTS = 16  # of the windows, whose gradients are compared across
_ALONE = "alone"  # in place of a λ: no value function, the window's rewards alone


def gradient_audit(
    *,
    environment: str = "diffrl_ant",
    finer: int = 4,
    stiffness: float = 1.0,
    updates: int = 300,
    environments: int = 64,
    windows: int = 4096,
    starts: int = 4096,
    batches: tuple[int, ...] = (64, 256, 1024),
    traces: tuple[float, ...] = (1.0, 0.8),
    seed: int = 0,
) -> None:
    """Print the table: a line per kind of gradient, λ and limit of a sample.

    Args:
        environment: a name of `mg.envs.ENVIRONMENTS`.
        finer: times, by which time steps are shorter.
        stiffness: factor of the stiffness of contact.
        updates: updates after which the policy is frozen.
        environments: copies in which it learned.
        windows: windows of which directions are made; the reference is from as many others.
        starts: number of those whose long returns tell the slope.
        batches: numbers of windows whose directions are compared with the reference.
        traces: each λ of the blended adjoint.
        seed: of everything.
    """
    mg.keep_compiled()
    announce(f"{environment}, contact {stiffness:g} times as stiff, {updates} updates, {windows} windows, float32")
    task = envs.load(environment).refined(finer)
    settings = learning.Settings(num_environments=environments).counted(float(task.interval))
    task = task if stiffness == 1 else task.with_softness(stiffer(task, stiffness))
    learned = learning.learn(task, jax.random.key(seed), num_updates=updates, settings=settings)
    print(learned, flush=True)
    frozen = _Frozen(learned, task, settings)
    keys = jax.random.split(jax.random.key(seed + 1), 4)
    states, others = (jax.jit(lambda k: frozen.starts(k, windows))(key) for key in keys[:2])
    noise = jax.random.normal(keys[2], (windows, settings.window, task.num_actions))
    found, references, agreed = {}, {}, {}
    for (name, trace), program in frozen.compiled(traces, states, noise).items():
        if trace == 1:
            window, gradients = program(states, noise, 0.0)
            alone = dataclasses.replace(gradients, zeroth=frozen.without_value(window, noise))
            agreed[name, _ALONE] = _agreement(frozen, window.seen, alone)
        if trace not in traces:
            continue
        window, gradients = program(states, noise, 1.0)
        agreed[name, trace] = _agreement(frozen, window.seen, gradients)
        other_window, other = program(others, noise[::-1], 1.0)
        for limit in _LIMITS:
            found[name, trace, limit] = window.seen, gradients.sound.shortened(limit)[0].first
        limited = other.sound.shortened(_LIMITS[-1])[0]
        references[name, trace] = frozen.direction(other_window.seen, limited.first)
        if name == "own":  # zeroth order has no derivative of a step
            found["zeroth", trace, math.inf] = window.seen, gradients.zeroth
            references["zeroth", trace] = frozen.direction(other_window.seen, other.zeroth)
    reference = jnp.stack([one / jnp.linalg.norm(one) for one in references.values()]).mean(axis=0)
    rise = jax.jit(frozen.rise)
    first = jax.tree.map(lambda x: x[:starts], states)
    long_noise = jax.random.normal(keys[3], (windows, _LONG, task.num_actions))[:starts]
    heads = ["gradient", "λ", "limit", *(f"cosine, {size}" for size in batches), "slope"]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for (name, trace, limit), (seen, by_action) in sorted(found.items()):
        cosines = [_cosines(frozen, seen, by_action, size, reference) for size in batches]
        rises = np.asarray(rise(frozen.direction(seen, by_action), first, long_noise))
        told = [quantity(rises.mean(), rises.std(ddof=1) / math.sqrt(len(rises)))]
        told = [quantity(x.mean(), x.std(ddof=1) / math.sqrt(len(x))) for x in cosines] + told
        print(f"| {' | '.join([name, f'{trace:g}', f'{limit:g}', *told])} |", flush=True)
    heads = ["cosine with zeroth order", *(f"value function, λ {trace:g}" for trace in traces), "rewards alone"]
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for name in _KINDS:
        print(f"| {' | '.join([name, *(quantity(*agreed[name, trace]) for trace in (*traces, _ALONE))])} |")


def _agreement(frozen: "_Frozen", seen: Array, gradients: Gradients) -> tuple[float, float]:
    """Return the cosine of both gradients' means, by products across parts of the windows alone, and its standard error."""
    shortened, limit = gradients.sound.shortened(_LIMITS[-1])[0], len(seen) // _PARTS
    rows = [slice(i * limit, (i + 1) * limit) for i in range(_PARTS)]
    first, zeroth = (
        np.stack([np.asarray(frozen.direction(seen[r], by_action[r]), float) for r in rows])
        for by_action in (shortened.first, gradients.zeroth)
    )

    def cosine(kept: np.ndarray) -> float:
        def across(x: np.ndarray, y: np.ndarray) -> float:
            return x[kept].sum(0) @ y[kept].sum(0) - (x[kept] * y[kept]).sum()

        lengths = across(first, first) * across(zeroth, zeroth)
        return across(first, zeroth) / math.sqrt(lengths) if lengths > 0 else math.nan

    every = np.arange(_PARTS)
    left_out = np.array([cosine(np.delete(every, i)) for i in every])  # the jackknife
    return cosine(every), math.sqrt((_PARTS - 1) * left_out.var())


def _cosines(
    frozen: "_Frozen", seen: Array, by_action: Array, size: int, reference: Array
) -> Float[np.ndarray, " batches"]:
    batches = [slice(i, i + size) for i in range(0, len(seen) - size + 1, size)][:_MOST_BATCHES]
    directions = (frozen.direction(seen[rows], by_action[rows]) for rows in batches)
    return np.array([one @ reference / jnp.linalg.norm(one) / jnp.linalg.norm(reference) for one in directions])


class _Frozen:
    """A policy that no longer learns, its value function, and the states it was in."""

    def __init__(self, learned: learning.Learned, task: Environment, settings: Counted):
        self.task, self.settings, self.learner = task, settings, learned.learner
        params, rest = eqx.partition(learned.policy.actor, eqx.is_inexact_array)
        self.params, unravel = ravel_pytree(params)
        self.actor_of = lambda flat: eqx.combine(unravel(flat), rest)
        self.stddev = jnp.asarray(settings.stddev[1])

    def value(self, seen: Float[Array, " seen"]) -> Float[Array, ""]:
        return self.learner.target(self.learner.normaliser(seen))

    def follow(self, flat: Array, state, noise: Array) -> tuple[Window, object]:
        return run_window(self.task, state, self.actor_of(flat), self.learner.normaliser, self.stddev * noise)

    def starts(self, key: PRNGKeyArray, number: int):
        """Draw states: copies of those in which learning ended, driven apart by noise on the actions."""
        own, driven = jax.random.split(key)
        states = self.learner.environments
        taken = jnp.arange(number) % self.settings.num_environments
        copies = eqx.tree_at(lambda s: s.key, jax.tree.map(lambda x: x[taken], states), jax.random.split(own, number))
        noise = jax.random.normal(driven, (number, _MIXED, self.task.num_actions))
        return jax.vmap(lambda state, noise: self.follow(self.params, state, noise)[1])(copies, noise)

    def without_value(
        self, window: Window, noise: Float[Array, "windows steps nu"]
    ) -> Float[Array, "windows steps nu"]:
        """Return the likelihood ratio of the window's rewards alone, less what a quadratic in the observations foretells."""
        returns = jax.vmap(lambda one: lambda_returns(one, lambda _: jnp.zeros(()), self.settings.discount, 1.0))(
            window
        )

        def left(returns: Float[Array, " windows"], seen: Float[Array, "windows seen"]) -> Float[Array, " windows"]:
            x = self.learner.normaliser(seen)
            known = jnp.concatenate([jnp.ones((len(x), 1)), x, x**2], axis=1)
            fitted = jnp.linalg.solve(known.T @ known + jnp.eye(known.shape[1]), known.T @ returns)
            return returns - known @ fitted

        advantages = jax.vmap(left, in_axes=1, out_axes=1)(returns, window.seen)
        weights = jax.vmap(lambda one: weights_in_return(one, self.settings.discount))(window)
        return (weights * advantages)[..., None] * noise / self.stddev

    def compiled(self, traces: tuple[float, ...], *example) -> dict:
        """Return programs from states, noise and a factor of the value function to windows and gradients, by kind and λ.

        Those of λ = 1, which can do without the value function, are among them. They compile side by side.
        """

        def lowered(contact: Contact, trace: float):
            task, learner, settings = self.task.with_contact(contact), self.learner, self.settings

            def one(state, noise: Array, share: Array) -> tuple[Window, Gradients]:
                state = dataclasses.replace(state, physics=task.completed(state.physics))
                networks = (self.actor_of(self.params), lambda seen: share * learner.target(seen), learner.normaliser)
                window, _, gradients = window_gradients(
                    task, state, learner.key, noise, *networks, self.stddev, settings.discount, trace
                )
                return window, gradients

            return jax.jit(jax.vmap(one, in_axes=(0, 0, None))).lower(*example, 1.0)

        wanted = list(itertools.product(_KINDS, dict.fromkeys((*traces, 1.0))))
        with ThreadPoolExecutor() as pool:
            programs = list(pool.map(lambda one: one.compile(), [lowered(_KINDS[k], trace) for k, trace in wanted]))
        return {(name, trace): program for (name, trace), program in zip(wanted, programs, strict=True)}

    def direction(self, seen: Float[Array, "windows steps seen"], by_action: Float[Array, "windows steps nu"]) -> Array:
        """Return the mean gradient by the parameters."""
        return jax.vjp(lambda flat: self.actions(flat, seen), self.params)[1](by_action)[0] / len(seen)

    def actions(self, flat: Array, seen: Float[Array, "*rows seen"]) -> Float[Array, "*rows nu"]:
        actor, rows = self.actor_of(flat), seen.reshape(-1, seen.shape[-1])
        obs = self.learner.normaliser(rows)[:, : self.learner.policy.normaliser.mean.size]
        return jax.vmap(actor)(obs).reshape(*seen.shape[:-1], -1)

    def rise(self, direction: Array, states, noise: Float[Array, "windows steps nu"]) -> Float[Array, " windows"]:
        """Return the slope of the long return along a direction, by start."""
        change = jax.jvp(lambda flat: self.actions(flat, states.seen), (self.params,), (direction,))[1]
        step = _WIDTH * direction / jnp.sqrt((change**2).mean())

        def gain(side: float) -> Float[Array, " windows"]:
            def one(state, noise: Array) -> Float[Array, ""]:
                window, _ = self.follow(self.params + side * step, state, noise)
                return returned(window, self.value, self.settings.discount)

            return jax.vmap(one)(states, noise)

        return (gain(1.0) - gain(-1.0)) / (2 * _WIDTH)
