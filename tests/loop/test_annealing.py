"""Smoothing that decreases while the cost is being optimised."""

import functools

import jax.numpy as jnp
import numpy as np
import optax

import mjxgrad as mg
from mjxgrad import estimators
from tests.loop import problems
from tests.loop.problems import made_up


def test_a_schedule_of_noise_is_followed(key):
    """E[bowl] exceeds bowl by scale² σ²/2 tr C, so the recorded cost tells the noise that was used."""
    schedule = optax.exponential_decay(1.0, 1, 0.5)
    result = mg.optimise(
        lambda scale: problems.objective.with_stddev(0.3 * scale),
        problems.CENTRE,
        key,
        estimator=functools.partial(estimators.zeroth_order, num_samples=4096),
        optimiser=optax.sgd(0.0),
        num_steps=4,
        annealing=schedule,
    )
    history, expected = result.history, 0.5 ** np.arange(4)
    np.testing.assert_allclose(history.scale, expected, rtol=1e-6)
    truth = (0.3 * expected) ** 2 / 2 * float(problems.CURVATURE.sum())
    assert np.all(np.abs(history.cost - truth) < 4 * history.cost_error)
    assert np.all(history.cost_error < 0.1 * truth)


def wavy(x):
    """Its global minimum is at 0, in one of many wells: noise of 0.5 hides all the others."""
    return 0.2 * (x**2).sum() - jnp.cos(8 * x).sum()


def test_smoothing_that_decreases_finds_what_none_and_much_do_not(key):
    """From 1.6 plain descent stays in a well near by (wells are 2π/8 apart); all the noise all the way leaves it blurred."""
    noisy = mg.parameter_noise(wavy, 0.5, dim=1)
    settings = {
        "estimator": functools.partial(estimators.first_order, num_samples=128),
        "optimiser": optax.sgd(0.02),
        "num_steps": 600,
    }
    annealed = mg.optimise(
        lambda scale: noisy.with_stddev(0.5 * scale),
        jnp.array([1.6]),
        key,
        annealing=optax.exponential_decay(1.0, 40, 0.7, transition_begin=300, end_value=0.05),
        **settings,
    )
    plain = mg.optimise(noisy.with_stddev(1e-3), jnp.array([1.6]), key, **settings)
    assert abs(annealed.params[0]) < 0.02
    assert abs(plain.params[0] - 1.53) < 0.1


def test_the_best_is_sought_where_smoothing_was_least(key):
    """The cost at much noise is made lower than ever after: it must not win."""

    def estimator(objective, params, key):
        return made_up(jnp.ones(2), cost=jnp.where(objective.stddev > 0.7, -5.0, params.sum()))

    result = mg.optimise(
        lambda scale: problems.objective.with_stddev(scale),
        jnp.zeros(2),
        key,
        estimator=estimator,
        optimiser=optax.sgd(0.1),
        num_steps=6,
        annealing=lambda step: jnp.where(step < 3, 1.0, 0.5),
    )
    np.testing.assert_allclose(result.best_params, -0.5)
    np.testing.assert_allclose(result.best_cost, -1.0)
