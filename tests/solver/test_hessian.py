"""The system of a Newton step: one kernel against the matrix and its factor."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.solver import hessian
from mjxgrad.solver.constraint import ConeGroup, RowHessian, RowLayout
from mjxgrad.solver.hessian import SparseRows
from mjxgrad.solver.jacobian import Group

# Every kind of group: equality, joint limits, frictionless contacts and pyramids, or elliptic contacts.
_SIMPLE = (Group((0, 1, 3), 1, 3), Group((1, 4), 2, is_diagonal=True), Group((0, 2), 2))
_PYRAMIDS = (Group((0, 2, 4), 2, 3, is_pyramid=True), Group((1, 3), 1, 2, is_pyramid=True))
_CONES = (Group((0, 2, 4), 2, 3), Group((1, 3), 1, 3))
_NV, _BATCH = 5, 37  # no multiple of a warp


def _problem(groups):
    random = np.random.default_rng(4)

    def positive(*shape):
        return jnp.asarray(random.uniform(0.5, 2.0, size=(*shape, _BATCH)))

    def any_sign(*shape):
        return jnp.asarray(random.normal(size=(*shape, _BATCH)))

    entries = (any_sign(g.num, g.dim, 1 if g.is_diagonal else len(g.dofs)) for g in groups)
    friction = (positive(g.num, g.dim - 1) if g.is_pyramid else None for g in groups)
    pieces = tuple(zip(entries, friction, strict=True))
    num_rows, cones = sum(g.num_rows for g in groups), sum(g.num for g in groups if g in _CONES)
    layout = RowLayout(0, 0, num_rows, (ConeGroup(num_rows - 3 * cones, cones, 3),) if cones else ())
    roots = any_sign(cones, 3, 3)
    row_hessian = RowHessian(
        positive(layout.simple_stop), (jnp.einsum("cijb,ckjb->cikb", roots, roots),) if cones else ()
    )
    mass = jnp.eye(_NV)[:, :, None] * positive(_NV)
    return layout, (mass, SparseRows(pieces, groups, _NV), row_hessian, any_sign(_NV))


@pytest.mark.parametrize("groups", [_SIMPLE + _PYRAMIDS, _SIMPLE + _CONES], ids=["pyramids", "cones"])
def test_one_kernel_does_what_the_operations_do(groups):
    layout, (mass, jacobian, row_hessian, vector) = _problem(groups)
    kernel = functools.partial(hessian.in_one_kernel, interpret=jax.default_backend() != "gpu")
    found, diagonal = jax.jit(functools.partial(kernel, layout))(mass, jacobian, row_hessian, vector)
    matrix = np.asarray(jax.jit(lambda *given: given[0].gram(given[1], layout, given[2]))(jacobian, mass, row_hessian))
    expected = np.linalg.solve(np.moveaxis(matrix, -1, 0), vector.T[..., None])[..., 0].T
    np.testing.assert_allclose(found, expected, rtol=1e-9)  # conditions up to 1e4
    np.testing.assert_allclose(diagonal, matrix[np.arange(_NV), np.arange(_NV)], rtol=1e-13)


def test_one_kernel_mends_what_the_operations_mend():
    """Where the rows outweigh a mass of a rank less, in single precision."""
    layout, problem = _problem(_SIMPLE)
    mass, jacobian, row_hessian, vector = jax.tree.map(lambda x: x.astype(jnp.float32), problem)
    mass = mass.at[:2, :2, 0].set(jnp.array([[1, 1.0001], [1.0001, 1]], jnp.float32))
    row_hessian = jax.tree.map(lambda x: x.at[:, 0].set(0.0), row_hessian)
    most, interpret = hessian.MAX_SHIFT, jax.default_backend() != "gpu"
    kernel = functools.partial(hessian.in_one_kernel, max_shift=most, interpret=interpret)
    found, _ = jax.jit(functools.partial(kernel, layout))(mass, jacobian, row_hessian, vector)
    solve = jax.jit(hessian.solve, static_argnums=(2, 5))
    (expected, _), (unmended, _) = (solve(mass, jacobian, layout, row_hessian, vector, shift) for shift in (most, 0.0))
    assert not np.isfinite(unmended[:, 0]).all()
    assert np.isfinite(expected).all()
    # A condition of 1e4 in single precision.
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3)
