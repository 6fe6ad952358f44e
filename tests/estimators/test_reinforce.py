"""REINFORCE with reward-to-go: against closed forms, as the other estimators."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from mjxgrad import estimators
from tests.estimators import textbook
from tests.estimators.textbook import assert_within_error

POLICY = {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.25])}
CONTROLS = jnp.array([0.4, -0.7, 0.2, 0.9])
reinforce = eqx.filter_jit(estimators.reinforce)


def closed_loop(stddev=0.3):
    return mg.closed_loop(textbook.LinearSystem(), textbook.linear_policy, stddev, params=POLICY)


@pytest.mark.parametrize("baseline", ["leave_one_out", "none"])
def test_reinforce_is_unbiased_for_a_policy(key, baseline):
    """Mean and covariance of a linear system under a linear policy follow by recursion, and so the expected cost."""
    cost = closed_loop()
    at = cost.ravel(POLICY)
    exact = jax.grad(lambda p: cost.task.expected_cost(cost.unravel(p), 0.3))(at)
    assert_within_error(reinforce(cost, at, key, num_samples=100_000, baseline=baseline), exact)


def test_reinforce_is_unbiased_for_controls(key):
    """The cost is quadratic in the controls, so noise adds a constant: the gradient is that without noise."""
    cost = mg.open_loop(textbook.LinearSystem(), 0.3)
    exact = jax.grad(lambda u: cost.task.run(u[:, None]).cost)(CONTROLS)
    assert_within_error(reinforce(cost, CONTROLS, key, num_samples=100_000), exact)


@pytest.mark.parametrize("baseline", ["leave_one_out", "none"])
def test_an_action_answers_for_what_comes_after_it_and_no_more(key, baseline):
    """The sum written out, for a few rollouts of controls."""
    cost, stddev = mg.open_loop(textbook.LinearSystem(), 0.3), 0.3
    noises = np.array([cost.sample_noise(jax.random.fold_in(key, i)) for i in range(5)])
    charged = np.array([cost.task.run(CONTROLS[:, None], noise=jnp.asarray(w)).step_costs for w in noises])
    samples = np.zeros((5, 4))
    for i in range(5):
        for t in range(4):
            others = np.mean([charged[j, t:].sum() for j in range(5) if j != i])
            advantage = charged[i, t:].sum() - (others if baseline == "leave_one_out" else 0)
            samples[i, t] = noises[i, t, 0] / stddev**2 * advantage
    estimate = reinforce(cost, CONTROLS, key, num_samples=5, baseline=baseline)
    np.testing.assert_allclose(estimate.value, samples.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(estimate.standard_error, samples.std(axis=0, ddof=1) / np.sqrt(5), rtol=1e-9)


def test_reward_to_go_spares_a_late_action_the_variance_of_what_came_before(key):
    """For the first action all of the cost is still to come; for the last one of ten, little."""
    cost, at = mg.open_loop(textbook.LinearSystem(horizon=10), 0.3), jnp.full(10, 0.3)
    whole = textbook.zeroth_order(cost, at, key, num_samples=4000)
    ratio = reinforce(cost, at, key, num_samples=4000).covariance_diagonal / whole.covariance_diagonal
    assert abs(ratio[0] - 1) < 0.01
    assert ratio[-1] < 0.3


def test_the_error_bar_of_reinforce_is_the_spread_of_its_repetitions(key):
    """2000 estimates of 30 rollouts; the spread of 2000 is known to about 1.6 %, and the share left out is 1/30."""
    cost = closed_loop()
    at = cost.ravel(POLICY)
    repeated = eqx.filter_jit(jax.vmap(lambda k: estimators.reinforce(cost, at, k, num_samples=30)))
    estimates = repeated(jax.random.split(key, 2000))
    claimed = np.sqrt((np.asarray(estimates.standard_error) ** 2).mean(axis=0))
    np.testing.assert_allclose(claimed, np.asarray(estimates.value).std(axis=0), rtol=0.1)


def test_reinforce_leaves_out_and_counts_what_is_not_finite(key):
    class Breaking(textbook.LinearSystem):
        def run(self, controls, params=None, noise=None, start=None):
            outcome = super().run(controls, params, noise, start)
            cost = jnp.where(noise[0, 0] > 0.1, jnp.nan, outcome.cost)
            return dataclasses.replace(outcome, cost=cost)

    cost = mg.open_loop(Breaking(), 0.3)
    noises = np.array([cost.sample_noise(jax.random.fold_in(key, i))[0, 0] for i in range(40)])
    estimate = reinforce(cost, CONTROLS, key, num_samples=40)
    assert estimate.num_finite == (noises <= 0.1).sum() < 40
    assert np.isfinite(estimate.value).all()


def test_reinforce_drives_an_optimisation(key):
    cost = closed_loop(0.1)
    result = mg.optimise(
        cost,
        cost.ravel(POLICY),
        key,
        estimator=functools.partial(estimators.reinforce, num_samples=32),
        optimiser=optax.adam(0.02),
        num_steps=100,
        evaluate=lambda p: cost.value(p, cost.zero_noise()),
    )
    assert result.final_cost < 0.7 * result.history.noise_free_cost[0]
    assert result.num_rollouts == 3200


def test_reinforce_needs_steps(key):
    with pytest.raises(ValueError, match=r"objective must have noise on actions.*got ParameterNoise"):
        estimators.reinforce(mg.parameter_noise(lambda x: (x**2).sum(), 0.3), jnp.zeros(2), key, num_samples=4)

    class Total(textbook.LinearSystem):
        def run(self, controls, params=None, noise=None, start=None):
            return dataclasses.replace(super().run(controls, params, noise, start), step_costs=None)

    with pytest.raises(ValueError, match="reinforce must be given a task with step_costs, got Total"):
        estimators.reinforce(mg.open_loop(Total(), 0.3), CONTROLS, key, num_samples=4)
    with pytest.raises(ValueError, match="num_samples must be at least 2, got 1"):
        estimators.reinforce(closed_loop(), jnp.zeros(3), key, num_samples=1)
