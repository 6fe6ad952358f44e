"""What the textbook problems say of themselves, against SciPy's quadrature of the definitions."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from experiments.problems import textbook
from mjxgrad.estimators import zeroth_order

STDDEV, POINT, BASELINE = 0.1, 0.03, 0.2
# The functions by themselves, with their kinks and jumps, not taken from the code on trial.
PROBLEMS = {
    "heaviside": (textbook.Heaviside(), lambda x: float(x >= 0), [0.0], POINT),
    "soft_heaviside": (textbook.SoftHeaviside(0.06), lambda x: np.clip(2 * x / 0.06, -1, 1), [-0.03, 0.03], POINT),
    "quadratic_sine": (textbook.QuadraticSine(0.1, 20.0), lambda x: x * x + 0.1 * np.sin(20 * x), [], 0.3),
}


def integral(function, breaks: list[float], point: float) -> float:
    """E function(x, z) over pieces on which it is smooth."""
    inside = [b for b in breaks if abs(b - point) < 8 * STDDEV]
    edges = sorted([*inside, *(point + STDDEV * k for k in range(-8, 9))])

    def weighted(x):
        return function(x, (x - point) / STDDEV) * norm.pdf(x, point, STDDEV)

    return sum(quad(weighted, a, b, epsabs=1e-13)[0] for a, b in itertools.pairwise(edges))


@pytest.fixture(scope="module", params=PROBLEMS)
def case(request):
    """What the problem says, and its function, breaks and point."""
    problem, function, breaks, point = PROBLEMS[request.param]

    @eqx.filter_jit
    def said(problem, point):
        return {
            "cost": problem(jnp.array([point])),
            "smoothed": problem.smoothed(point, STDDEV),
            "gradient": problem.gradient(point, STDDEV),
            "first_mean": problem.first_order_mean(point, STDDEV),
            "first_variance": problem.first_order_variance(point, STDDEV),
            "mean_square": problem.mean_square(point, STDDEV, BASELINE),
            "zeroth_variance": problem.zeroth_order_variance(point, STDDEV, BASELINE),
        }

    return said(problem, point), function, breaks, point


def slope(function, x: float) -> float:
    return (function(x + 1e-7) - function(x - 1e-7)) / 2e-7


def test_smoothed_cost_and_gradient_are_the_means_under_noise_of_cost_and_cost_times_score(case):
    said, function, breaks, point = case
    assert said["cost"] == pytest.approx(function(point), rel=1e-12)
    assert said["smoothed"] == pytest.approx(integral(lambda x, _: function(x), breaks, point), rel=1e-7)
    expected = integral(lambda x, z: function(x) * z / STDDEV, breaks, point)
    assert said["gradient"] == pytest.approx(expected, rel=1e-6)


def test_first_order_moments_are_those_of_the_derivative_between_the_breaks(case):
    said, function, breaks, point = case
    mean = integral(lambda x, _: slope(function, x), breaks, point)
    square = integral(lambda x, _: slope(function, x) ** 2, breaks, point)
    # No node of the quadrature is so near a break that the central difference would see it.
    assert said["first_mean"] == pytest.approx(mean, rel=1e-5, abs=1e-9)
    assert said["first_variance"] == pytest.approx(square - mean**2, rel=1e-5, abs=1e-9)


def test_the_zeroth_order_variance_is_that_of_cost_less_baseline_times_score(case):
    said, function, breaks, point = case
    mean = integral(lambda x, z: function(x) * z / STDDEV, breaks, point)
    square = integral(lambda x, z: ((function(x) - BASELINE) * z / STDDEV) ** 2, breaks, point)
    assert said["zeroth_variance"] == pytest.approx(square - mean**2, rel=1e-6)
    assert said["mean_square"] == pytest.approx(
        integral(lambda x, _: (function(x) - BASELINE) ** 2, breaks, point), rel=1e-7
    )


def test_a_sweep_of_widths_is_one_vmap_and_keeps_its_digits_at_any_width():
    """A ramp of width ν is a step of height 2 but for terms of order (ν/σ)²/24 · |z² − 1|."""
    widths = jnp.array([1e-3, 1e-6, 1e-9, 1e-12])
    sweep = jax.vmap(lambda width: textbook.SoftHeaviside(width).gradient(POINT, STDDEV))(widths)
    np.testing.assert_allclose(sweep, 2 * norm.pdf(POINT / STDDEV) / STDDEV, rtol=5e-6)
    np.testing.assert_allclose(sweep[1:], 2 * norm.pdf(POINT / STDDEV) / STDDEV, rtol=1e-11)


def test_the_leave_one_out_variance_is_that_of_many_short_estimates():
    """N = 3, where the terms in 1/(N(N − 1)) are a third of the whole."""
    problem, repeats = textbook.SoftHeaviside(0.06), 40_000
    keys = jax.random.split(jax.random.key(0), repeats)

    @eqx.filter_jit
    def estimates(keys):
        return jax.vmap(
            lambda key: zeroth_order(problem.objective(STDDEV), jnp.array([POINT]), key, num_samples=3).value[0]
        )(keys)

    values = np.asarray(estimates(keys))
    squares = (values - float(problem.gradient(POINT, STDDEV))) ** 2
    exact = float(problem.leave_one_out_variance(POINT, STDDEV, 3))
    assert abs(squares.mean() - exact) < 4 * squares.std() / np.sqrt(repeats)
