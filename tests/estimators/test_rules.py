"""The rules that choose α, on evidence made by hand, and their confidence, by repetition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.estimators import Reason, rules
from mjxgrad.estimators.evidence import Evidence
from mjxgrad.estimators.rules import confidence_radius


def evidence(**changes) -> Evidence:
    """50 samples of 3 coordinates: inverse variance gives 0.8, and nothing speaks against first order."""
    facts = {
        "count": 50.0,
        "dim": 3.0,
        "first_norm": 2.0,
        "difference_norm": 0.3,
        "first_variance": 1.0,
        "zeroth_variance": 4.0,
        "difference_variance": 5.0,
        "cost_variance": 3.0,
        "scaled_first_variance": 0.5,
        "scaled_first_norm": 2.0,
        "squared_bias": -0.01,
        "squared_bias_error": 0.05,
        "noise_dim": 1e12,
        "squared_bias_bound": 9.0,
        "squared_jump_bound": 9.0,
        "zeroth_noise": 4 / 50,
        "first_noise": 1 / 50,
        "num_estimates": 1.0,
    } | changes
    shape = np.broadcast_shapes(*map(np.shape, facts.values()))
    return Evidence(**{name: jnp.broadcast_to(jnp.asarray(value), shape) for name, value in facts.items()})


RARE = 2 / 3 * np.log(1e4) - 1.5  # of the least noise that first order is taken to have
RADIUS = 2.0095752 * np.sqrt(4 / 50)


def assert_decides(rule, facts: Evidence, alpha: float, reason, bias_bound: float) -> None:
    weights = rule(facts)
    np.testing.assert_allclose(weights.alpha, alpha, rtol=1e-7)
    np.testing.assert_allclose(weights.bias_bound, bias_bound, rtol=1e-7)
    assert Reason[weights.reason] == Reason[reason]


@pytest.mark.parametrize(
    ("rule", "changes", "alpha", "reason", "bound"),
    [
        (rules.FixedAlpha(0.3), {}, 0.3, Reason.fixed, np.nan),
        (rules.InverseVariance(), {}, 0.8, Reason.inverse_variance, np.nan),
        (rules.LeastRisk(), {}, 0.8, Reason.inverse_variance, 0.8 * 3.0),
        # A squared bias of 0.35 less one error of 0.05; it counts once, or ten times, or as far as derivatives miss anything.
        (rules.LeastRisk(), {"squared_bias": 0.35}, 0.08 / 0.4, Reason.bias_limit, 0.2 * 3.0),
        (rules.LeastRisk(), {"squared_bias": 0.3, "noise_dim": 1.0}, 0.08 / 0.4, Reason.bias_limit, 0.2 * 3.0),
        (rules.LeastRisk(), {"squared_bias": 0.325, "noise_dim": 2.0}, 0.08 / 0.4, Reason.bias_limit, 0.2 * 3.0),
        (
            rules.LeastRisk(),
            {"squared_bias": 0.35, "num_estimates": 10.0},
            0.08 / 3.1,
            Reason.bias_limit,
            0.08 / 3.1 * 3.0,
        ),
        (
            rules.LeastRisk(),
            {"squared_bias": 0.35, "squared_bias_bound": 0.06},
            0.08 / 0.16,
            Reason.bias_limit,
            0.5 * 0.06**0.5,
        ),
        # What noise of p coordinates exceeds with the probability of 2√(V/V⁰), here 1/5 or 1, is no bias: so many errors.
        # V is at least pJ/n and V⁰/100.
        *[
            (
                rules.LeastRisk(),
                {
                    "first_noise": noise,
                    "squared_jump_bound": jumps,
                    "squared_bias": 0.03 + 0.05 * errors,
                    "noise_dim": dim,
                },
                0.08 / (0.11 + noise),
                Reason.bias_limit,
                0.08 / (0.11 + noise) * 3.0,
            )
            for noise, jumps, dim, errors in [
                (8e-4, 0.0, 4.0, np.sqrt(2 * np.log(5)) + np.log(5) / np.sqrt(2)),
                (0.0, 0.01, 4.0, np.sqrt(2 * np.log(5)) + np.log(5) / np.sqrt(2)),
                (0.0, 0.0, 1.0, np.sqrt(2 * RARE) + RARE * np.sqrt(2)),
                (0.0, 1.0, 1.0, 0.0),
            ]
        ],
        # Without noise and bias there is nothing to weigh.
        (rules.LeastRisk(), {"zeroth_noise": 0.0, "first_noise": 0.0}, 1.0, Reason.inverse_variance, 3.0),
        # Student's 0.975 quantile of 49 degrees, times the error of the zeroth order: the ball's radius.
        (rules.TrustRegion(), {}, 1.0, Reason.inside, RADIUS + 0.3),
        (rules.TrustRegion(), {"difference_norm": 1.5}, RADIUS / 1.5, Reason.bias_limit, 2 * RADIUS),
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


@pytest.mark.parametrize("dim", [1, 5])
@pytest.mark.parametrize("failure_probability", [0.05, 0.2])
@pytest.mark.parametrize("count", [5, 100])
def test_the_empirical_radius_fails_at_most_as_often_as_it_says(dim, failure_probability, count):
    """Gaussian samples of unequal variances; one coordinate is the worst case, and there the bound is exact."""
    rng, times = np.random.default_rng(0), 20_000
    samples = rng.normal(size=(times, count, dim)) * np.linspace(1, 0.3, dim)
    norms = np.linalg.norm(samples.mean(axis=1), axis=1)
    variance = jnp.asarray(samples.var(axis=1, ddof=1).sum(axis=1))
    radius = jax.vmap(lambda v: confidence_radius(v, jnp.array(float(count)), failure_probability))(variance)
    failures = (norms > np.asarray(radius)).mean()
    error = np.sqrt(failure_probability * (1 - failure_probability) / times)
    assert failures < failure_probability + 4 * error
    if dim == 1:
        assert failures > failure_probability - 4 * error
