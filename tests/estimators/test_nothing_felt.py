"""Where nothing that the parameters change reaches the cost, every estimate says so; and nowhere else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad import estimators
from mjxgrad.estimators import Reason
from tests.estimators import textbook

ESTIMATORS = {
    "first_order": estimators.first_order,
    "zeroth_order": estimators.zeroth_order,
    "zero_noise": functools.partial(estimators.zeroth_order, baseline="zero_noise"),
    "pairs": functools.partial(estimators.zeroth_order, antithetic=True),
    "alpha_order": estimators.alpha_order,
    "control_variate": estimators.control_variate,
}
NOWHERE_NEAR, NEAR = jnp.array([0.0, 0.2]), jnp.array([0.9, 0.2])


def dead_zone(x):
    """Nothing within 1 of zero, then a slope."""
    return 1e6 + jnp.maximum(jnp.abs(x) - 1, 0.0).sum()


def feels_nothing(estimator, function, points):
    """What is said at each of the points, in one compiled and batched program with chunks; and the estimates."""

    def one(point):
        objective = mg.parameter_noise(function, 0.1)
        return estimator(objective, point, jax.random.key(3), num_samples=16, chunk_size=6)

    found = jax.jit(jax.vmap(one))(points)
    return np.asarray(found.reason == Reason.nothing_felt), found


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_dead_zone_is_named_and_its_edge_is_not(name):
    """From 0.9 the noise of 0.1 takes one sample in six over the edge."""
    said, estimate = feels_nothing(ESTIMATORS[name], dead_zone, jnp.stack([NOWHERE_NEAR, NEAR]))
    assert said[0].all()
    assert not said[1].any()
    np.testing.assert_allclose(estimate.value[0], 0, atol=1e-8)
    assert np.all(np.asarray(estimate.alpha)[0] == (1 if name == "first_order" else 0))


@pytest.mark.parametrize(("slope", "is_felt"), [(1e-20, False), (1e-3, True)])
def test_a_gradient_of_rounding_is_said_to_be_none(key, slope, is_felt):
    """As a solver leaves it on what nothing touches; costs scatter there by its tolerance, which is felt by zeroth order."""
    objective = mg.parameter_noise(lambda x: 0.5 + slope * jnp.cos(x).sum(), 0.1)
    told = str(estimators.alpha_order(objective, jnp.ones(8), key, num_samples=16))
    assert ("nothing is felt: the cost does not depend on what is moved, or only by jumps" in told) != is_felt
    assert ("no bias was found" in told) == is_felt


@pytest.mark.parametrize("name", ESTIMATORS)
def test_an_optimum_is_felt(name):
    """Costs differ under noise, be it small, and so do derivatives; also where all costs round to the same number."""

    def reason(constant, stddev):
        objective = mg.parameter_noise(lambda x: constant + (x**2).sum(), stddev)
        return ESTIMATORS[name](objective, jnp.zeros(2), jax.random.key(3), num_samples=16, chunk_size=6).reason

    found = jax.jit(jax.vmap(reason))(jnp.array([0.0, 1e9]), jnp.array([1e-6, 1e-5]))
    is_felt = np.asarray(found != Reason.nothing_felt)
    assert is_felt[0].all()
    assert is_felt[1].all() or name not in ("first_order", "alpha_order", "control_variate")


def test_noise_that_is_zero_is_no_evidence():
    """At an optimum without noise all costs are the same and all derivatives are zero."""

    def one(stddev):
        objective = mg.parameter_noise(lambda x: (x**2).sum(), stddev)
        return estimators.first_order(objective, jnp.zeros(2), jax.random.key(0), num_samples=4).reason

    assert not np.any(jax.vmap(one)(jnp.array([0.0, 0.1])) == Reason.nothing_felt)


def test_a_step_that_some_samples_meet_is_felt(key):
    """Its derivative is zero everywhere; the costs tell."""
    estimate = estimators.first_order(mg.parameter_noise(textbook.step, 0.1), jnp.zeros(1), key, num_samples=16)
    assert estimate.reason == Reason.fixed


def test_samples_that_are_not_finite_are_felt(key):
    cost = mg.parameter_noise(lambda x: jnp.where(x[0] > 0, jnp.nan, 3.0), 0.1)
    estimate = estimators.alpha_order(cost, jnp.zeros(1), key, num_samples=16)
    assert 2 < estimate.num_finite < 16
    assert estimate.reason != Reason.nothing_felt


class Untouched(textbook.RandomStart):
    """A ball that rolls from a random start and never meets the hand; the cost is where it ends."""

    def run(self, controls, params=None, noise=None, start=None):
        return super().run(jnp.zeros((self.horizon, 1)), start=start)


@pytest.mark.parametrize("name", ["alpha_order", "zero_noise"])
def test_random_starts_are_compared_with_themselves(key, name):
    """Costs differ by their starts; from the same start they do not. The same system with a hand on it is felt."""
    controls, run = jnp.zeros(4), functools.partial(ESTIMATORS[name], num_samples=16)
    for task, is_nothing in ((Untouched(), True), (textbook.RandomStart(), False)):
        estimate = run(mg.open_loop(task, 0.1), controls, key)
        assert estimate.objective_standard_error > 0
        assert bool(estimate.reason == Reason.nothing_felt) == is_nothing
