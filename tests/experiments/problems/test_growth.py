"""Growth of products of Jacobians, from closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.problems.growth import growth


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
