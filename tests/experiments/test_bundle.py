"""Bundled gradients: the motion as it is, the derivative of its neighbours."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.bundle import Bundle, bundled
from mjxgrad import envs


@pytest.fixture(scope="module")
def cartpole():
    return envs.load("diffrl_cartpole")


def speed_after(environment, state, angle):
    """The pole's rate after one action, by the angle it starts from."""
    physics = dataclasses.replace(state.physics, qpos=state.physics.qpos.at[1].set(angle))
    moved = environment.step(dataclasses.replace(state, physics=physics), jnp.array([0.3]))
    return moved.physics.qvel[1]


def test_the_motion_is_as_it_is_and_the_derivative_a_mean(cartpole, key):
    """The slope of gravity's torque, sin(angle), is averaged over a normal spread s to cos(angle) exp(−s²/2), by its series.

    Against the same mean by quadrature of plain derivatives. 4000 branches of spread 0.5 leave an error of a hundredth.
    """
    state, spread = cartpole.reset(key), 0.5
    averaged = bundled(cartpole, Bundle(num_branches=4000, length=spread, speed=0.0))
    plain = jax.jit(jax.vmap(jax.value_and_grad(lambda x: speed_after(cartpole, state, x))))
    value, slope = jax.jit(jax.value_and_grad(lambda x: speed_after(averaged, state, x)))(0.4)
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    _, slopes = plain(0.4 + spread * jnp.asarray(nodes))
    mean = weights @ np.asarray(slopes) / weights.sum()
    assert_allclose(value, plain(jnp.array([0.4]))[0][0], rtol=1e-12)
    assert_allclose(slope, mean, rtol=0.03)
    assert abs(mean / plain(jnp.array([0.4]))[1][0] - 1) > 0.05  # the mean is another number than the derivative there


def test_what_is_seen_and_earned_is_as_it_is(cartpole, key):
    state, action = cartpole.reset(key), jnp.array([0.3])
    plain, averaged = (jax.jit(lambda s, a, e=e: e.step(s, a))(state, action) for e in (cartpole, bundled(cartpole)))
    for name in ("obs", "reward", "terminated", "num_steps"):
        # Two programs may be compiled to different rounding.
        assert_allclose(getattr(averaged, name), getattr(plain, name), rtol=1e-12)
