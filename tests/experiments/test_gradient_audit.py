"""The audit of gradients: what a return gains along a direction is the derivative along it where nothing jumps."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.gradient_audit import _cosines, _Frozen
from mjxgrad import envs, learning

_STEPS, _STARTS = 8, 16


def test_the_slope_along_the_mean_gradient_of_a_smooth_return_is_its_norm(monkeypatch):
    """With λ = 1, a window as long as the return and the same noise, per unit of change of the actions."""
    monkeypatch.setattr("experiments.gradient_audit._WIDTH", 0.005)
    settings = learning.Settings(num_environments=4, window=_STEPS, trace=1.0)
    task = envs.diffrl.cartpole()
    frozen = _Frozen(learning.learn(task, jax.random.key(0), num_updates=1, settings=settings), task, settings)
    states = jax.jit(lambda key: frozen.starts(key, _STARTS))(jax.random.key(1))
    noise = jax.random.normal(jax.random.key(2), (_STARTS, _STEPS, task.num_actions))
    window, gradients = frozen.compiled((1.0,), states, noise)["own", 1.0](states, noise)
    direction = frozen.direction(window.seen, gradients.first)
    _, change = jax.jvp(lambda flat: frozen.actions(flat, states.seen), (frozen.params,), (direction,))
    slope = direction @ direction / jnp.sqrt((change**2).mean())
    rises = np.asarray(jax.jit(frozen.rise)(direction, states, noise))
    np.testing.assert_allclose(rises.mean(), slope, rtol=1e-3)  # differences of 0.5 % of an action
    np.testing.assert_allclose(_cosines(frozen, window.seen, gradients.first, _STARTS, direction), 1.0, atol=1e-6)
