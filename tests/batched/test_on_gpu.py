"""What a GPU does in kernels of its own, run here by an interpreter: against numpy, and against the same as operations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.batched import cholesky, on_gpu
from mjxgrad.bodies.kinematics import Inertia
from mjxgrad.solver import newton
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.jacobian import AxisRows, DenseRows, JoinedRows
from mjxgrad.solver.newton import System

_INTERPRET = jax.default_backend() != "gpu"
_BATCH = 5


def _last(x):
    return jnp.moveaxis(jnp.asarray(x), 0, -1)


@pytest.mark.parametrize(
    ("size", "num_rows"), [(1, 0), (5, 3), (16, 40), (17, 3), (32, 9), (35, 9)]
)  # one block, two, and four
def test_solves_what_rows_add_up_to(size, num_rows):
    random = np.random.default_rng(size)
    roots, vector = random.normal(size=(_BATCH, size, size)), random.normal(size=(_BATCH, size))
    mass = roots @ roots.transpose(0, 2, 1) + np.eye(size)
    left, scale = random.normal(size=(_BATCH, num_rows, size)), random.uniform(0, 2, size=(_BATCH, num_rows))
    scale[:, ::3] = 0.0
    right = left * 1.5  # as of elliptic contacts: not the same, and yet symmetric
    matrix = mass + np.einsum("bri,br,brj->bij", left, scale, right)
    rows = (_last(left), _last(scale), _last(right)) if num_rows else ()
    solve = jax.jit(functools.partial(on_gpu.solve, interpret=_INTERPRET))
    found, diagonal = solve(_last(mass), _last(vector), *rows)
    expected = np.linalg.solve(matrix, vector[..., None])[..., 0]
    # Conditions up to 1e4 times eps of double precision.
    np.testing.assert_allclose(found.T, expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(diagonal.T, np.einsum("bii->bi", matrix), rtol=1e-13)


@pytest.mark.parametrize("bad", [2, 18])  # in the first block, and in the second
def test_an_indefinite_member_is_not_finite_and_its_neighbour_is_right(bad):
    mass = np.stack([np.diag(np.arange(1.0, 21.0))] * 2)
    mass[0, bad, bad] = -1.0
    found = jax.jit(functools.partial(on_gpu.solve, interpret=_INTERPRET))(_last(mass), jnp.ones((20, 2)))[0]
    assert not np.isfinite(found[:, 0]).any()
    np.testing.assert_allclose(found[:, 1], 1 / np.arange(1.0, 21.0), rtol=1e-14)


@pytest.mark.parametrize("place", [2, 15, 18])  # in the first block, across both, and in the second
def test_what_rounding_made_indefinite_is_mended_by_the_least_share_of_its_diagonal(place):
    mass = np.stack([np.diag(np.arange(1.0, 21.0))] * 3)
    least = 1e-9
    mass[0, place : place + 2, place : place + 2] = 7 * np.array([[1, 1 + least], [1 + least, 1]])
    mass[2, place, place] = -1.0
    solve = functools.partial(on_gpu.solve, max_shift=0.01, interpret=_INTERPRET)
    found, _ = jax.jit(solve)(_last(mass), jnp.tile(jnp.arange(1.0, 21.0)[:, None], 3))
    share = np.finfo(float).eps
    while share <= least:
        share *= 4
    expected = np.linalg.solve(mass[0] + share * np.diag(np.diag(mass[0])), np.arange(1.0, 21.0))
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-6)  # a condition of 1e9 times rounding
    np.testing.assert_allclose(found[:, 1], np.ones(20), rtol=1e-14)
    assert not np.isfinite(found[:, 2]).any()


def _problem(size, bad=None):
    """Return a random problem with all kinds of rows; losses and limits see one joint velocity each, the others all."""
    random = np.random.default_rng(3)
    layout = RowLayout(num_equality=2, num_friction=3, num_rows=30)
    roots = random.normal(size=(_BATCH, size, size))
    mass, force = roots @ roots.transpose(0, 2, 1) + np.eye(size), 30 * random.normal(size=(_BATCH, size))
    if bad is not None:
        force[bad, 0] = np.nan
    jacobian, reference = _last(random.normal(size=(_BATCH, 30, size))), 20 * random.normal(size=(_BATCH, 30))
    weight, bound = 10 ** random.uniform(-1, 3, size=(_BATCH, 30)), random.uniform(1, 50, size=(_BATCH, 30))
    active = random.uniform(size=(_BATCH, 30)) < 0.8
    rows = Rows(_last(reference), _last(weight), _last(bound), ())
    sign = jacobian[:, 0]
    axes = (AxisRows(sign[2:5], (1, 2, size - 1), size), AxisRows(sign[5:10], tuple(range(1, 6)), size))
    entries = JoinedRows((DenseRows(jacobian[:2, None]), *axes, DenseRows(jacobian[10:, None])))
    return layout, System(Inertia(_last(mass)), _last(force), entries, _last(active), rows)


def _one_by_one(layout, iterations, *args):
    """Solve each state alone, which like a program ends its search along a line without waiting for others."""
    members = [jax.tree.map(lambda x, k=k: x[..., k], args) for k in range(_BATCH)]
    return jax.tree.map(lambda *x: jnp.stack(x, axis=-1), *(newton.minimise(layout, iterations, *m) for m in members))


def _both(size, iterations=100, bad=None, expected=newton.minimise):
    """Return acceleration and count, by operations and by the kernel."""
    layout, system = _problem(size, bad)
    start, tolerance = jnp.zeros((size, _BATCH)), jnp.full(_BATCH, 1e-10)
    kernel = functools.partial(newton.in_one_kernel, interpret=_INTERPRET)
    return [jax.jit(functools.partial(way, layout, iterations))(system, start, tolerance) for way in (expected, kernel)]


@pytest.mark.parametrize(("size", "iterations"), [(7, 1), (20, 100)])
def test_takes_the_same_steps_to_the_same_minimiser(size, iterations):
    """The first step and the end; in between a difference of rounding may send the search along a line another way."""
    way = _one_by_one if iterations == 1 else newton.minimise
    (expected, count), (found, other) = _both(size, iterations, expected=way)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    if iterations == 1:  # which was too few
        np.testing.assert_array_equal(count, 2)
        np.testing.assert_array_equal(other, 2)
    else:
        assert (other < 30).all()


def test_without_a_minimiser_there_is_no_number_and_its_neighbours_have_one():
    (_, count), (found, other) = _both(7, bad=1)
    assert np.isnan(found[:, 1]).all()
    assert np.isfinite(np.delete(found, 1, axis=1)).all()
    assert (count[1], other[1]) == (101, 101)


@pytest.mark.skipif(
    jax.__version_info__ >= (0, 11) and jax.default_backend() != "gpu",
    reason="from 0.11 on JAX lowers GPU kernels only where there is a GPU",
)
def test_a_gpu_is_given_one_kernel_and_the_cpu_beside_it_none(monkeypatch):
    monkeypatch.setattr(on_gpu, "has_kernels", lambda: True)
    layout, system = _problem(7)
    force, tolerance = system.force, jnp.full(_BATCH, 1e-10)
    solve = jax.jit(cholesky.cholesky_solve).trace(system.inertia.matrix, force)
    minimise = jax.jit(functools.partial(newton.minimise, layout, 100)).trace(system, force, tolerance)
    for traced in (solve, minimise):
        lowered = {name: traced.lower(lowering_platforms=(name,)).as_text() for name in ("cuda", "cpu")}
        assert {name: text.count("gpu.triton") for name, text in lowered.items()} == {"cuda": 1, "cpu": 0}
