"""Eigenvectors of small symmetric matrices, by rotations."""

import jax
import numpy as np
import pytest

from mjxgrad.batched import linear


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1, 2, 4, 5])
def test_any_small_matrix_is_taken_apart(size: int, precision: type):
    """Also one that lacks rank, has equal eigenvalues, is diagonal, or whose entries differ by a million."""
    random, num = np.random.default_rng(size), 200
    factors = random.normal(size=(num, size, 3)) * 10 ** random.uniform(-3, 3, (num, size, 1))
    factors[:50, 0] = 0.0
    factors[50:100, -1] = factors[50:100, 0]
    matrices = (factors @ factors.transpose(0, 2, 1)).astype(precision)
    matrices[100:120] = np.eye(size)
    matrices[120:140] *= np.eye(size)
    values, vectors = (np.asarray(x, float) for x in jax.jit(jax.vmap(linear.eigh))(matrices))
    largest = np.abs(matrices).max(axis=(1, 2)) + 1e-30
    rounding = 20 * np.finfo(precision).eps  # a rotation for each pair and sweep
    off = np.abs((vectors * values[:, None]) @ vectors.transpose(0, 2, 1) - matrices).max(axis=(1, 2)) / largest
    assert off.max() < rounding
    assert np.abs(vectors @ vectors.transpose(0, 2, 1) - np.eye(size)).max() < rounding
