"""REINFORCE with reward-to-go, the linear fit to samples, and rules of others, against closed forms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from mjxgrad import estimators
from mjxgrad.estimators import Reason, rules
from mjxgrad.objective import parameter_noise
from tests.estimators import textbook
from tests.estimators.test_rules import assert_decides, evidence
from tests.estimators.textbook import POINT, POLICY_PARAMS, STDDEVS, assert_within_error

CONTROLS = jnp.array([0.4, -0.7, 0.2, 0.9])
reinforce = eqx.filter_jit(estimators.reinforce)
least_squares = eqx.filter_jit(estimators.least_squares)


def test_it_is_numpys_fit_to_the_same_samples_chunks_and_missing_ones_included(key):
    def cost(x):
        return jnp.where(x[2] > -0.3, jnp.nan, textbook.bumpy(x))

    objective = parameter_noise(cost, STDDEVS)
    estimate = least_squares(objective, POINT, key, num_samples=50, chunk_size=7)
    noise = np.array([objective.sample_noise(jax.random.fold_in(key, i)) for i in range(50)])
    costs = np.array([cost(POINT + w) for w in noise])
    kept = np.isfinite(costs)
    assert estimate.num_finite == kept.sum() < 50
    assert estimate.num_gradient_rollouts == 0
    design = np.column_stack([np.ones(kept.sum()), noise[kept]])
    fit, *_ = np.linalg.lstsq(design, costs[kept])
    np.testing.assert_allclose(estimate.value, fit[1:], rtol=1e-9)


def test_it_finds_the_slope_of_a_smoothed_step_and_its_error(key):
    objective, point, times = parameter_noise(textbook.step, 0.1, dim=1), jnp.array([0.05]), 4000
    run = jax.jit(jax.vmap(lambda k: estimators.least_squares(objective, point, k, num_samples=200)))
    estimates = run(jax.random.split(key, times))
    values = np.asarray(estimates.value)[:, 0]
    # The fit's own bias falls as 1/N: 0.5 % at 200 samples is generous.
    np.testing.assert_allclose(values.mean(), norm.pdf(0.05, scale=0.1), rtol=0.005)
    ratio = (np.asarray(estimates.standard_error) ** 2).mean() / values.var()
    assert 0.95 < ratio < 1.15  # HC3 is on the safe side


def test_too_few_samples_and_noise_that_is_not_on_the_parameters_are_refused(key):
    with pytest.raises(ValueError, match=r"num_samples must be more than dim \+ 1 = 4, got 4"):
        estimators.least_squares(parameter_noise(textbook.bumpy, STDDEVS), POINT, key, num_samples=4)
    objective = closed_loop()
    with pytest.raises(ValueError, match="noise on the parameters"):
        estimators.least_squares(objective, objective.ravel(POLICY_PARAMS), key, num_samples=40)


def closed_loop(stddev=0.3):
    return mg.closed_loop(textbook.LinearSystem(), textbook.linear_policy, stddev, params=POLICY_PARAMS)


@pytest.mark.parametrize("baseline", ["leave_one_out", "none"])
def test_reinforce_is_unbiased_for_a_policy(key, baseline):
    """Mean and covariance of a linear system under a linear policy follow by recursion, and so the expected cost."""
    cost = closed_loop()
    at = cost.ravel(POLICY_PARAMS)
    exact = jax.jit(jax.grad(lambda p: cost.task.expected_cost(cost.unravel(p), 0.3)))(at)
    assert_within_error(reinforce(cost, at, key, num_samples=100_000, baseline=baseline), exact)


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


@pytest.mark.parametrize(
    ("changes", "alpha"),
    [({"difference_norm": 1e9}, 0.8), ({"first_variance": 0.0, "zeroth_variance": 0.0}, 1.0)],
)
def test_inverse_variance_looks_at_variances_alone(changes, alpha):
    assert_decides(rules.InverseVariance(), evidence(**changes), alpha, Reason.inverse_variance, np.nan)


def test_the_concavity_test_is_the_published_inequality():
    """V¹ = 0.5 and ‖g¹‖ = 2 allow a variance of the cost of (V¹ + 2 ‖g¹‖²) / (2 (1 - c))."""
    boundary = (0.5 + 2 * 2.0**2) / (2 * 0.7)
    for cost_variance, alpha in ((0.999 * boundary, 0.8), (1.001 * boundary, 0.0)):
        weights = rules.Concavity(slack=0.3)(evidence(cost_variance=cost_variance))
        np.testing.assert_allclose(weights.alpha, alpha)
    assert Reason[weights.reason] == Reason[Reason.inconsistent]


def test_every_component_is_weighed_by_its_own_variances(key):
    """The definition written out: terms with the leave-one-out mean, variances by component, their quotient."""
    objective = parameter_noise(textbook.bumpy, STDDEVS)
    noise = np.array([objective.sized_for(POINT).sample_noise(jax.random.fold_in(key, i)) for i in range(30)])
    costs, slopes = map(np.asarray, jax.vmap(jax.value_and_grad(textbook.bumpy))(POINT + jnp.asarray(noise)))
    zeroth = 30 / 29 * (costs - costs.mean())[:, None] * noise / np.asarray(STDDEVS) ** 2
    first_variance, zeroth_variance = slopes.var(axis=0, ddof=1), zeroth.var(axis=0, ddof=1)
    alpha = zeroth_variance / (zeroth_variance + first_variance)
    estimate = estimators.per_step_inverse_variance(objective, POINT, key, num_samples=30)
    np.testing.assert_allclose(estimate.value, (alpha * slopes + (1 - alpha) * zeroth).mean(axis=0), rtol=1e-7)
    np.testing.assert_allclose(estimate.alpha, alpha.mean(), rtol=1e-9)
