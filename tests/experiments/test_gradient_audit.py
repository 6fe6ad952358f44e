"""The audit of gradients: what a return gains along a direction is the derivative along it where nothing jumps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import gradient_audit
from experiments.gradient_audit import _cosines, _Frozen
from mjxgrad import envs, learning
from mjxgrad.learning.learner import ActorCritic

_STEPS, _STARTS = 8, 16


@pytest.fixture(scope="module")
def frozen():
    """A policy and a value function that learnt nothing; the last layer of the value function is ones, not zeros."""
    layers = {"actor_layers": (16, 8), "critic_layers": (8, 8)}
    settings = learning.Settings(num_environments=4, window=_STEPS, trace=1.0, **layers).counted(1 / 60)
    task = envs.diffrl.cartpole()
    learner = eqx.filter_jit(ActorCritic(task, settings, 1).init)(jax.random.key(0))
    learner = eqx.tree_at(lambda one: one.target.network.layers[-1].weight, learner, replace_fn=jnp.ones_like)
    return _Frozen(learning.Learned(learner.policy, {}, learner), task, settings)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [("own",), ("slope", "onset")], ids="-".join)
def test_the_slope_along_the_mean_gradient_of_a_smooth_return_is_its_norm(frozen, kinds, monkeypatch):
    """With λ = 1, a window as long as the return and the same noise, per unit of change of the actions."""
    monkeypatch.setattr("experiments.gradient_audit._WIDTH", 0.005)
    monkeypatch.setattr("experiments.gradient_audit._KINDS", {kind: gradient_audit._KINDS[kind] for kind in kinds})
    states = jax.jit(lambda key: frozen.starts(key, _STARTS))(jax.random.key(1))
    noise = jax.random.normal(jax.random.key(2), (_STARTS, _STEPS, frozen.task.num_actions))
    programs = frozen.compiled((1.0,), states, noise)
    rise = jax.jit(frozen.rise)
    for kind in kinds:
        window, gradients = programs[kind, 1.0](states, noise, 1.0)
        direction = frozen.direction(window.seen, gradients.first)
        _, change = jax.jvp(lambda flat: frozen.actions(flat, states.seen), (frozen.params,), (direction,))
        slope = direction @ direction / jnp.sqrt((change**2).mean())
        rises = np.asarray(rise(direction, states, noise))
        np.testing.assert_allclose(rises.mean(), slope, rtol=1e-3)  # differences of 0.5 % of an action
        cosines = _cosines(frozen, window.seen, gradients.first, _STARTS, direction)
        np.testing.assert_allclose(cosines, 1.0, atol=1e-6)
