"""Growth of products of Jacobians and the crossing of two errors, from closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.diagnostics import crossover, growth


def repeated(matrix, count):
    return jnp.broadcast_to(jnp.asarray(matrix), (count, *np.shape(matrix)))


def test_the_product_of_shears_grows_as_its_number():
    """The n-th power of [[1, a], [0, 1]] is [[1, n a], [0, 1]], whose largest singular value is na/2 + √(n²a²/4 + 1)."""
    n = np.arange(1, 21)
    expected = np.arcsinh(n * 0.7 / 2)
    assert np.allclose(growth(repeated([[1.0, 0.7], [0.0, 1.0]], 20)).log_largest, expected, rtol=1e-12)


def test_the_order_of_the_factors_is_that_of_the_steps():
    """B A stretches (1, 0) by 6 where A = [[0, 0], [2, 0]] comes first and B = [[0, 3], [0, 0]] second; A B is another."""
    first, second = jnp.array([[0.0, 0.0], [2.0, 0.0]]), jnp.array([[0.0, 3.0], [0.0, 0.5]])
    assert np.exp(growth(jnp.stack([first, second])).log_largest[-1]) == pytest.approx(2 * np.hypot(3, 0.5))


def test_the_stretches_over_time_are_all_exponents():
    """Of the same symmetric matrix again and again they tend to the logarithms of its eigenvalues, 3 and 1/2."""
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    found = growth(repeated(turn @ np.diag([3.0, 0.5]) @ turn.T, 200)).exponents(jnp.arange(1.0, 201.0))[-1]
    assert np.allclose(found, np.log([3.0, 0.5]), atol=1 / 200)  # the start's share falls as one over the number


def test_a_long_product_neither_overflows_nor_hides_small_stretches():
    """e^20 and e^−20 two hundred times are far beyond the range of numbers."""
    found = growth(repeated(np.diag([np.exp(20.0), np.exp(-20.0)]), 200))
    assert float(found.log_largest[-1]) == pytest.approx(4000)
    assert np.allclose(found.log_stretches[-1], [4000, -4000])


def test_batches_are_grown_one_by_one(key):
    jacobians = jax.random.normal(key, (3, 5, 2, 2))
    sizes = [np.linalg.norm(np.linalg.multi_dot(one[::-1]), ord=2) for one in np.asarray(jacobians)]
    assert np.allclose(growth(jacobians).log_largest[:, -1], np.log(sizes), rtol=1e-10)


HORIZONS = np.linspace(1.0, 10.0, 10)


def squared_errors(rng, scale, repeats=200):
    return scale * rng.chisquare(3, size=(repeats, len(HORIZONS))) / 3


def test_the_crossing_of_an_exponential_and_a_constant_is_covered():
    """e^(t − 4.3) and 1 cross at 4.3."""
    rng = np.random.default_rng(0)
    found = crossover(HORIZONS, squared_errors(rng, np.exp(HORIZONS - 4.3)), squared_errors(rng, 1.0))
    assert found.low < 4.3 < found.high
    assert found.high - found.low < 0.5  # √(2 · 2/3/200) of a logarithm, that is 0.08, times 4


def test_the_interval_of_a_crossing_covers_as_often_as_it_says():
    rng, hits = np.random.default_rng(1), 0
    for _ in range(60):
        first, second = squared_errors(rng, np.exp(HORIZONS - 4.3), 40), squared_errors(rng, 1.0, 40)
        found = crossover(HORIZONS, first, second, num_resamples=100)
        hits += found.low <= 4.3 <= found.high
    assert 51 <= hits <= 60  # 57 give or take three and a half standard deviations of a binomial


def test_what_does_not_cross_is_infinite_or_the_beginning():
    ones = np.ones((4, len(HORIZONS)))
    assert crossover(HORIZONS, ones, 2 * ones).horizon == np.inf
    assert crossover(HORIZONS, ones, 2 * ones).high == np.inf
    assert crossover(HORIZONS, 2 * ones, ones).horizon == 1.0


def test_a_passing_draw_is_no_crossing():
    ratio = np.where(HORIZONS == 2, 1.5, np.exp(HORIZONS - 6.5))
    first, second = np.broadcast_to(ratio, (4, 10)), np.ones((4, 10))
    assert crossover(HORIZONS, first, second).horizon == pytest.approx(6.5)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((HORIZONS[::-1].copy(), np.ones((4, 10)), np.ones((4, 10))), "horizons must increase"),
        ((HORIZONS[1:], np.ones((1, 9)), np.ones((1, 9))), "at least two repeats"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        crossover(*arguments)
