"""Search in the same loop: against closed forms, with rollouts counted alike."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from mjxgrad.baselines import cross_entropy
from tests.estimators import textbook
from tests.loop import problems
from tests.loop.problems import START, bowl

objective = problems.objective.with_stddev(0.3)
search = functools.partial(cross_entropy, num_samples=40, num_elite=8, stddev=2.0)


@pytest.fixture(scope="module")
def both():
    """Two seeds in one program."""
    keys = jax.random.split(jax.random.key(4), 2)
    return search(objective, START, keys, num_steps=60, evaluate=bowl, evaluate_every=1)


def test_it_ends_at_the_minimum(both):
    assert np.all(both.best_cost < 0.02)
    assert np.all(both.final_cost < 0.1)
    assert np.all(both.stopped == mg.Stopped.finished)
    assert both.params.shape == (2, 2)
    assert not np.array_equal(both.params[0], both.params[1])


def test_every_candidate_is_counted(both):
    np.testing.assert_array_equal(both.history.num_rollouts, np.broadcast_to(40 * np.arange(1, 61), (2, 60)))
    assert np.all(both.num_gradient_rollouts == 0)


def test_cross_entropy_fits_a_truncated_gaussian(key):
    """On a slope the elite is the lower tail: mean -σφ(z)/ρ and variance σ²(1 - zφ(z)/ρ - (φ(z)/ρ)²), z = Φ⁻¹(ρ).

    The second step moves by the same in units of the first one's σ, by which that is seen, too.
    """
    share, stddev = 0.2, 0.7
    z = norm.ppf(share)
    hazard = norm.pdf(z) / share
    expected = -stddev * hazard * (1 + np.sqrt(1 - z * hazard - hazard**2))
    slope = mg.parameter_noise(lambda x: x[0], 1.0)
    result = cross_entropy(slope, jnp.zeros(1), key, num_samples=50_000, num_elite=10_000, num_steps=2, stddev=stddev)
    # Mean and deviation of ten thousand elite: each step is within about σ/100 of the limit.
    np.testing.assert_allclose(result.params[0], expected, atol=0.03 * stddev)


def test_candidates_that_are_not_finite_are_counted_and_never_followed(key):
    """Half of the plane is NaN and would be the better half."""
    cost = mg.parameter_noise(lambda x: jnp.where(x[0] > 0.5, jnp.nan, bowl(x)), 0.3, dim=2)
    result = search(cost, START, key, num_steps=30)
    assert result.params[0] <= 0.5
    assert np.abs(result.params[1] + 2) < 0.3
    assert 0 < result.history.finite_fraction.min() < 1


def test_nothing_finite_is_no_step(key):
    cost = mg.parameter_noise(lambda x: x.sum() * jnp.nan, 0.3, dim=2)
    result = search(cost, START, key, num_steps=30, patience=3)
    assert result.stopped == mg.Stopped.not_finite
    assert result.num_rollouts == 120
    np.testing.assert_array_equal(result.params, START)


def test_candidates_have_starts_of_their_own_and_no_noise_on_actions(key):
    cost = mg.open_loop(textbook.RandomStart(), 0.1)
    actions, starts = jax.vmap(lambda k: cost.silence(cost.sample_noise(k)))(jax.random.split(key, 50))
    np.testing.assert_array_equal(actions, 0)
    assert len(np.unique(starts[:, 0])) == 50
