"""Linear and bilinear maps, as a CPU and as a GPU evaluates them, against sums over all entries, with their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.dynamics import maps, spatial

BILINEAR = {
    "cross": spatial.cross,
    "motion": spatial.cross_motion,
    "force": spatial.cross_force,
    "momentum": spatial.momentum,
    "products": maps.Bilinear(np.arange(24.0).reshape(2, 3, 4) % 5 - 2),
    "an entry of none": maps.Bilinear(np.array([[[1.0, 0.0]], [[0.0, 0.0]]])),
    "nothing": maps.Bilinear(np.zeros((2, 3, 1))),
}
LINEAR = {
    "sums": np.tril(np.ones((5, 5))),
    "a choice": np.eye(4)[[2, 2, 0]],
    "signs": np.array([[1.0, 0, -1], [0, 0, 0], [0, 2.5, 0]]),
    "many terms": np.ones((2, maps._MOST_GATHERED + 1)),
    "nothing": np.zeros((0, 3)),
    "of nothing": np.zeros((2, 0)),
}

_WAYS = (maps._evaluate, maps._evaluate_by_gathers)


def _table(bilinear, of_first, of_second):
    table = np.zeros((bilinear._size, of_first, of_second))
    for k, i, j, coefficient in bilinear._terms:
        table[k, i, j] = coefficient
    return table


def _sizes(bilinear):
    """Return how many entries the factors need."""
    _, i, j, _ = (
        (np.array(x, int) for x in zip(*bilinear._terms, strict=True)) if bilinear._terms else ([], [0], [0], [])
    )
    return int(max(i)) + 1, int(max(j)) + 1


@pytest.mark.parametrize("evaluate", _WAYS)
@pytest.mark.parametrize("name", BILINEAR)
def test_a_bilinear_map_is_its_sum(name, evaluate):
    bilinear = BILINEAR[name]
    sizes = _sizes(bilinear)
    a, b = (jax.random.normal(jax.random.key(seed), (3, 2, size)) for seed, size in enumerate(sizes))
    found = evaluate(a, b, terms=bilinear._terms, size=bilinear._size)
    np.testing.assert_allclose(
        found, np.einsum("kij,...i,...j->...k", _table(bilinear, *sizes), a, b), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("name", BILINEAR)
def test_an_entry_that_is_no_number_spoils_only_what_is_made_of_it(name):
    bilinear = BILINEAR[name]
    sizes = _sizes(bilinear)
    a, b = (jnp.ones(size) for size in sizes)
    for entry in range(sizes[0]):
        spoilt = a.at[entry].set(jnp.nan)
        found = (evaluate(spoilt, b, terms=bilinear._terms, size=bilinear._size) for evaluate in _WAYS)
        np.testing.assert_array_equal(*map(np.isnan, found))


@pytest.mark.parametrize("name", ["sums", "a choice", "signs"])
def test_an_item_that_is_no_number_spoils_only_gathered_sums_of_it(name):
    matrix = LINEAR[name]
    for item in range(matrix.shape[1]):
        x = jnp.ones(matrix.shape[1]).at[item].set(jnp.nan)
        found = maps._combine_by_gathers(x, matrix=maps._Matrix(matrix), axis=0)
        np.testing.assert_array_equal(np.isnan(found), matrix[:, item] != 0)


def test_chosen_items_have_the_derivative_of_an_index():
    """In both modes, whatever the derivatives of those that are not chosen."""
    index, x = jnp.array([[2, 0], [2, 2]]), jax.random.normal(jax.random.key(0), (4, 3))
    change = jax.random.normal(jax.random.key(1), x.shape).at[1].set(jnp.nan)
    found, moved = jax.jvp(lambda x: maps.choose(index, x), (x,), (change,))
    np.testing.assert_array_equal(found, x[index])
    np.testing.assert_allclose(moved, change[index], rtol=1e-14)
    cotangent = jax.random.normal(jax.random.key(2), found.shape)
    (pulled,) = jax.vjp(lambda x: maps.choose(index, x), x)[1](cotangent)
    np.testing.assert_allclose(pulled, jnp.zeros_like(x).at[index].add(cotangent), rtol=1e-14)


@pytest.mark.parametrize("name", BILINEAR)
def test_the_transposes_of_a_bilinear_map_are_those_of_its_sum(name):
    bilinear = BILINEAR[name]
    sizes = _sizes(bilinear)
    table = _table(bilinear, *sizes)
    a, b, cotangent = (jax.random.normal(jax.random.key(size), (4, size)) for size in (*sizes, bilinear._size))
    by_a, by_b = jax.vjp(jax.vmap(bilinear), a, b)[1](cotangent)
    np.testing.assert_allclose(by_a, np.einsum("kij,nk,nj->ni", table, cotangent, b), rtol=0, atol=1e-13)
    np.testing.assert_allclose(by_b, np.einsum("kij,nk,ni->nj", table, cotangent, a), rtol=0, atol=1e-13)


@pytest.mark.parametrize("evaluate", [maps._combine, maps._combine_by_gathers])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_map_is_its_sum(name, axis, evaluate):
    matrix = LINEAR[name]
    x = jax.random.normal(jax.random.key(0), np.insert([3, 2], axis, matrix.shape[1]))
    found = evaluate(x, matrix=maps._Matrix(matrix), axis=axis)
    np.testing.assert_allclose(found, np.moveaxis(np.tensordot(matrix, x, (1, axis)), 0, axis), rtol=0, atol=1e-13)


@pytest.mark.parametrize("batch", [0, 1])
@pytest.mark.parametrize("name", LINEAR)
def test_the_transpose_of_a_linear_map_is_that_of_its_matrix(name, batch):
    matrix = LINEAR[name]
    shapes = [np.insert([size, 2], batch, 3) for size in matrix.shape[::-1]]
    x, cotangent = (jax.random.normal(jax.random.key(seed), shape) for seed, shape in enumerate(shapes))
    mapped = jax.vmap(lambda x: maps.combine(matrix, x), batch, batch)
    (found,) = jax.vjp(mapped, x)[1](cotangent)
    contracted = 1 - batch
    expected = np.moveaxis(np.tensordot(matrix.T, cotangent, (1, contracted)), 0, contracted)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
