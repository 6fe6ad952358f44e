"""Sums that are written out, against numpy."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.batched import linear


@pytest.mark.parametrize("length", [1, linear.LONGEST_SUM, linear.LONGEST_SUM + 1, 4 * linear.LONGEST_SUM + 3])
def test_an_inner_product_leaves_no_row_out(length):
    """Long ones are folded by halves, of which an odd row is left over."""
    random = np.random.default_rng(length)
    x, y = random.normal(size=(2, length, 3))
    # Rounding of so many terms of size one.
    np.testing.assert_allclose(linear.dot(jnp.asarray(x), jnp.asarray(y)), (x * y).sum(axis=0), atol=1e-13)
