"""The claimed standard errors, by repetition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from mjxgrad.objective import ParameterNoise, parameter_noise
from tests.estimators import textbook
from tests.estimators.textbook import first_order, repeat, zeroth_order

EVERY_WAY = [(baseline, pairs) for baseline in ("leave_one_out", "zero_noise", "none") for pairs in (False, True)]


def slanted(x: Float[Array, " 2"]) -> Float[Array, ""]:
    """Mostly linear: then cost and score are strongly correlated, and the baseline's own error matters."""
    return 2.0 + 3 * x[0] - x[1] + 4 * x[0] ** 2 + x[0] * x[1]


class HalfMirrored(ParameterNoise):
    """Mirrors one of two coordinates: also equally likely, but the scores of a pair do not cancel."""

    def mirror(self, noise: Float[Array, " dim"]) -> Float[Array, " dim"]:
        return noise * jnp.array([-1.0, 1.0])


def assert_errors_are_right(estimates, num_repetitions: int) -> None:
    """The mean squared standard error is the variance of the estimates."""
    values, squared = np.asarray(estimates.value), np.asarray(estimates.standard_error) ** 2
    deviations = (values - values.mean(axis=0)) ** 2
    variance = deviations.sum(axis=0) / (num_repetitions - 1)
    # Both sides are means over repetitions; they are correlated, so the sum of their errors is the safe bound.
    error = (deviations.std(axis=0) + squared.std(axis=0)) / np.sqrt(num_repetitions)
    np.testing.assert_array_less(np.abs(squared.mean(axis=0) - variance), 3 * error)
    np.testing.assert_array_less(error, 0.1 * variance)


@pytest.mark.parametrize(
    ("estimator", "settings"),
    [
        (first_order, {}),
        *((zeroth_order, {"baseline": baseline, "antithetic": pairs}) for baseline, pairs in EVERY_WAY),
    ],
)
def test_an_estimate_knows_its_error_even_from_three_samples(estimator, settings):
    times, num_samples = 20_000, 6 if settings.get("antithetic") else 3
    objective, point = parameter_noise(slanted, jnp.array([0.3, 0.5])), jnp.array([0.4, -0.7])
    estimates = repeat(estimator, objective, point, times=times, seed=1, num_samples=num_samples, **settings)
    assert_errors_are_right(estimates, times)


def test_pairs_whose_scores_do_not_cancel_know_their_error():
    times = 20_000
    objective = HalfMirrored(jax.tree_util.Partial(slanted), jnp.array([0.3, 0.5]), 2)
    point = jnp.array([0.4, -0.7])
    estimates = repeat(zeroth_order, objective, point, times=times, seed=2, num_samples=6, antithetic=True)
    assert_errors_are_right(estimates, times)
    # E f over the Gaussian has this gradient by hand: 3 + 8x + y and -1 + x.
    exact = np.array([3 + 8 * 0.4 - 0.7, -1 + 0.4])
    error = np.asarray(estimates.value).std(axis=0) / np.sqrt(times)
    np.testing.assert_array_less(np.abs(np.asarray(estimates.value).mean(axis=0) - exact), 4 * error)


def test_the_mean_cost_knows_its_error():
    times, point = 4000, 0.3
    objective = parameter_noise(textbook.quadratic_sine, textbook.STDDEV)
    estimates = repeat(first_order, objective, jnp.array([point]), times=times, seed=8, num_samples=20)
    # E x² = θ² + σ², E sin(ωx) = exp(-ω²σ²/2) sin(ωθ).
    exact = point**2 + 0.01 + 0.1 * np.exp(-(20**2) * 0.01 / 2) * np.sin(20 * point)
    means, errors = np.asarray(estimates.objective_mean), np.asarray(estimates.objective_standard_error)
    assert abs(means.mean() - exact) < 4 * means.std() / np.sqrt(times)
    assert (errors**2).mean() == pytest.approx(means.var(), rel=4 * np.sqrt(2 / times))
