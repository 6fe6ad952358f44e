"""Cholesky solves, by each of the ways that the devices have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.dynamics import cholesky

_WAYS = {
    "written out": cholesky.written_out,
    "chosen": cholesky.cholesky_solve,
}


def _systems(size: int, num: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(size)
    roots = random.normal(size=(num, size, size))
    return roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(size), random.normal(size=(num, size))


@pytest.mark.parametrize("way", _WAYS.values(), ids=_WAYS)
@pytest.mark.parametrize(("size", "num"), [(1, 3), (5, 45)])  # fewer than a warp; more, and no multiple of it
def test_solves_every_member_of_the_batch(way, size: int, num: int):
    matrices, vectors = _systems(size, num)
    found = jax.jit(way)(jnp.moveaxis(matrices, 0, -1), vectors.T)
    expected = np.linalg.solve(matrices, vectors[..., None])[..., 0].T
    # Conditions up to 1e3 times eps of double precision.
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("way", _WAYS.values(), ids=_WAYS)
def test_an_indefinite_member_is_not_finite_and_its_neighbour_is_right(way):
    matrices, vectors = _systems(3, 2)
    matrices[0, 2, 2] = -100.0
    found = jax.jit(way)(jnp.moveaxis(matrices, 0, -1), vectors.T)
    assert not np.isfinite(found[:, 0]).any()
    np.testing.assert_allclose(found[:, 1], np.linalg.solve(matrices[1], vectors[1]), rtol=1e-10)
