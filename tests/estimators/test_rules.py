"""The rules that choose α, on evidence made by hand, and their confidence, by repetition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.estimators import Reason, rules
from mjxgrad.estimators.rules import Evidence, confidence_radius


def evidence(**changes) -> Evidence:
    """50 samples of 3 coordinates: inverse variance gives 0.8, and nothing speaks against first order."""
    facts = {
        "count": 50,
        "dim": 3.0,
        "first_norm": 2.0,
        "difference_norm": 0.3,
        "first_variance": 1.0,
        "zeroth_variance": 4.0,
        "difference_variance": 5.0,
        "inconsistency": 0.01,
        "relative_bias_bound": 0.05,
        "cost_variance": 3.0,
        "scaled_first_variance": 0.5,
        "scaled_first_norm": 2.0,
    } | changes
    return Evidence(**{name: jnp.asarray(value) for name, value in facts.items()})


def assert_decides(rule, facts: Evidence, alpha: float, reason, bias_bound: float) -> None:
    weights = rule(facts)
    np.testing.assert_allclose(weights.alpha, alpha, rtol=1e-12)
    np.testing.assert_allclose(weights.bias_bound, bias_bound, rtol=1e-9)
    assert Reason[weights.reason] == Reason[reason]


@pytest.mark.parametrize(
    ("rule", "changes", "alpha", "reason", "bound"),
    [
        (rules.FixedAlpha(0.3), {}, 0.3, Reason.fixed, np.nan),
        (rules.Consistent(), {}, 0.8, Reason.inverse_variance, 0.8 * 0.05 * 2.0),
        (rules.Consistent(threshold=0.1), {"inconsistency": 0.11}, 0.0, Reason.inconsistent, 0.0),
    ],
)
def test_a_rule_weighs_by_what_it_looks_at_alone(rule, changes, alpha, reason, bound):
    assert_decides(rule, evidence(**changes), alpha, reason, bound)


# sqrt(2 V ln((d+1)/δ) / N) + 2 L ln((d+1)/δ) / (3 N) with V = 4, d = 3, δ = 0.05, N = 50, L = 6
BERNSTEIN = np.sqrt(2 * 4 * np.log(4 / 0.05) / 50) + 2 * 6 * np.log(4 / 0.05) / 150


@pytest.mark.parametrize(
    ("gamma", "alpha", "reason"),
    [
        (BERNSTEIN - 0.01, 0.0, Reason.uncertain),
        (BERNSTEIN + 0.8 * 0.3 + 0.01, 0.8, Reason.inverse_variance),
        (BERNSTEIN + 0.5 * 0.3, 0.5, Reason.bias_limit),
    ],
)
def test_the_bias_is_kept_below_gamma_by_bernsteins_inequality(gamma, alpha, reason):
    rule = rules.BiasConstrained(gamma, bound=6.0, failure_probability=0.05)
    assert_decides(rule, evidence(), alpha, reason, alpha * (0.3 + BERNSTEIN))


def test_a_difference_beyond_its_own_noise_counts_as_error_of_the_first_order():
    """Quantile 2.00958: the noise of the difference is 2.00958 sqrt(5/50); V⁰/(V⁰ + V¹ + n excess)."""
    excess = 1.5**2 - 2.0095752**2 * 5 / 50
    alpha = 4 / (4 + 1 + 50 * excess)
    weights = rules.Consistent()(evidence(difference_norm=1.5))
    np.testing.assert_allclose(weights.alpha, alpha, rtol=1e-6)
    assert Reason[weights.reason] == Reason[Reason.bias_limit]


@pytest.mark.parametrize("dim", [1, 5])
@pytest.mark.parametrize("failure_probability", [0.05, 0.2])
@pytest.mark.parametrize("count", [5, 100])
def test_the_empirical_radius_fails_at_most_as_often_as_it_says(dim, failure_probability, count):
    """Gaussian samples of unequal variances; one coordinate is the worst case, and there the bound is exact."""
    rng, times = np.random.default_rng(0), 20_000
    samples = rng.normal(size=(times, count, dim)) * np.linspace(1, 0.3, dim)
    norms = np.linalg.norm(samples.mean(axis=1), axis=1)
    variance = jnp.asarray(samples.var(axis=1, ddof=1).sum(axis=1))
    radius = jax.vmap(lambda v: confidence_radius(v, jnp.array(count), failure_probability))(variance)
    failures = (norms > np.asarray(radius)).mean()
    error = np.sqrt(failure_probability * (1 - failure_probability) / times)
    assert failures < failure_probability + 4 * error
    if dim == 1:
        assert failures > failure_probability - 4 * error
