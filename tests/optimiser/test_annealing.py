"""Smoothing that decreases while the cost is being optimised."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from mjxgrad import estimators
from tests.optimiser import problems
from tests.optimiser.problems import made_up

PLATEAU = mg.Plateau(factor=0.5, patience=4, tolerance=0.0, minimum=0.2)


def scales(costs, cost_errors, plateau=PLATEAU):
    """The scale of each step, given what the steps before it cost."""

    def step(state, seen):
        return plateau.update(state, *seen), plateau.scale(state, jnp.zeros((), int))

    costs = jnp.asarray(costs, float)
    errors = jnp.broadcast_to(jnp.asarray(cost_errors, float), costs.shape)
    return np.asarray(jax.lax.scan(step, plateau.init(costs.dtype), (costs, errors))[1])


def test_a_plateau_keeps_the_scale_while_the_cost_falls():
    np.testing.assert_array_equal(scales(np.arange(40.0, 0.0, -1.0), 0.0), 1.0)


def test_a_plateau_lowers_the_scale_after_two_blocks_without_improvement_down_to_its_minimum():
    """After each change two blocks of four must be seen again: 1, then 1/2, 1/4, and 0.2 for good."""
    expected = np.repeat([1.0, 0.5, 0.25, 0.2], [8, 8, 8, 16])
    np.testing.assert_array_equal(scales(np.ones(40), 0.0), expected)


def test_an_improvement_within_the_error_bar_does_not_count():
    """Blocks improve by 0.4; their difference has the standard error e √(1/4 + 1/4), which is 0.5 for e = 0.71."""
    costs = np.repeat(10 - 0.4 * np.arange(3), 4)
    assert scales(costs, 0.71)[-1] == 0.5
    assert scales(costs, 0.5)[-1] == 1.0


def test_a_relative_improvement_below_the_tolerance_does_not_count():
    costs = np.repeat(-10 - 0.4 * np.arange(3), 4)
    assert scales(costs, 0.0, mg.Plateau(factor=0.5, patience=4, tolerance=0.05))[-1] == 0.5
    assert scales(costs, 0.0, mg.Plateau(factor=0.5, patience=4, tolerance=0.03))[-1] == 1.0


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
        annealing=mg.Plateau(factor=0.7, patience=20, minimum=0.05),
        **settings,
    )
    plain = mg.optimise(noisy.with_stddev(1e-3), jnp.array([1.6]), key, **settings)
    assert abs(annealed.params[0]) < 0.02
    assert abs(plain.params[0] - 1.53) < 0.1
    # Watching the cost has cost nothing.
    assert annealed.num_rollouts == plain.num_rollouts == 600 * 128


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


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"factor": 1.0}, "factor must be between 0 and 1, got 1.0"),
        ({"patience": 0}, "patience must be at least 1, got 0"),
        ({"tolerance": -0.1}, "tolerance must be at least 0, got -0.1"),
        ({"minimum": 0.0}, "minimum must be above 0 and at most 1, got 0.0"),
    ],
)
def test_a_plateau_without_meaning_is_refused(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        mg.Plateau(**settings)
