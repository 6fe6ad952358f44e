"""Linear, bilinear and Einstein sums, as a CPU and as a GPU evaluates them, against NumPy's, with their derivatives."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.batched import linear, maps
from mjxgrad.bodies import spatial
from tests.processes import run_python

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
    "many terms": np.ones((2, maps.LONGEST_SUM + 1)),
    "one that is long": np.concatenate([np.eye(6)[[0, 0, 1, 2]], -np.ones((2, 6)), np.eye(6)[3:]]),
    "nothing": np.zeros((0, 3)),
    "of nothing": np.zeros((2, 0)),
}

_WAYS = (maps._bilinear_by_slices, maps._bilinear_by_gathers)


def _normal(seed, shape):
    """Return random numbers by NumPy: JAX would compile a program for each shape."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


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
@pytest.mark.parametrize("bilinear", BILINEAR.values(), ids=BILINEAR)
def test_a_bilinear_map_is_its_sum(bilinear, evaluate):
    sizes = _sizes(bilinear)
    a, b = (_normal(seed, (3, 2, size)) for seed, size in enumerate(sizes))
    found = evaluate(a, b, terms=bilinear._terms, size=bilinear._size, batch=0)
    np.testing.assert_allclose(
        found, np.einsum("kij,...i,...j->...k", _table(bilinear, *sizes), a, b), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("bilinear", BILINEAR.values(), ids=BILINEAR)
def test_an_entry_that_is_no_number_spoils_only_what_is_made_of_it(bilinear):
    sizes = _sizes(bilinear)
    a, b = (jnp.ones(size) for size in sizes)
    for entry in range(sizes[0]):
        spoilt = a.at[entry].set(jnp.nan)
        found = (evaluate(spoilt, b, terms=bilinear._terms, size=bilinear._size, batch=0) for evaluate in _WAYS)
        np.testing.assert_array_equal(*map(np.isnan, found))


@pytest.mark.parametrize("name", ["sums", "a choice", "signs"])
def test_an_item_that_is_no_number_spoils_only_gathered_sums_of_it(name):
    matrix = LINEAR[name]
    for item in range(matrix.shape[1]):
        x = jnp.ones(matrix.shape[1]).at[item].set(jnp.nan)
        found = maps._linear_by_gathers(x, matrix=maps._Matrix(matrix), batch=0)
        np.testing.assert_array_equal(np.isnan(found), matrix[:, item] != 0)


def test_chosen_items_have_the_derivative_of_an_index():
    """In both modes, whatever the derivatives of those that are not chosen."""
    index, x = jnp.array([[2, 0], [2, 2]]), _normal(0, (4, 3))
    change = _normal(1, x.shape).at[1].set(jnp.nan)
    found, moved = jax.jvp(lambda x: maps.choose(index, x), (x,), (change,))
    np.testing.assert_array_equal(found, x[index])
    np.testing.assert_allclose(moved, change[index], rtol=1e-14)
    cotangent = _normal(2, found.shape)
    (pulled,) = jax.vjp(lambda x: maps.choose(index, x), x)[1](cotangent)
    np.testing.assert_allclose(pulled, jnp.zeros_like(x).at[index].add(cotangent), rtol=1e-14)


@pytest.mark.parametrize("bilinear", BILINEAR.values(), ids=BILINEAR)
def test_the_transposes_of_a_bilinear_map_are_those_of_its_sum(bilinear):
    sizes = _sizes(bilinear)
    table = _table(bilinear, *sizes)
    a, b, cotangent = (_normal(size, (4, size)) for size in (*sizes, bilinear._size))
    by_a, by_b = jax.vjp(jax.vmap(bilinear), a, b)[1](cotangent)
    np.testing.assert_allclose(by_a, np.einsum("kij,nk,nj->ni", table, cotangent, b), rtol=0, atol=1e-13)
    np.testing.assert_allclose(by_b, np.einsum("kij,nk,ni->nj", table, cotangent, a), rtol=0, atol=1e-13)


@pytest.mark.parametrize("evaluate", [maps._linear_by_slices, maps._linear_by_gathers])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("matrix", LINEAR.values(), ids=LINEAR)
def test_a_linear_map_is_its_sum(matrix, axis, evaluate):
    x = _normal(0, np.insert([3, 2], axis, matrix.shape[1]))
    found = evaluate(x, matrix=maps._Matrix(matrix), batch=axis)
    np.testing.assert_allclose(found, np.moveaxis(np.tensordot(matrix, x, (1, axis)), 0, axis), rtol=0, atol=1e-13)


@pytest.mark.parametrize("batch", [0, 1])
@pytest.mark.parametrize("matrix", LINEAR.values(), ids=LINEAR)
def test_the_transpose_of_a_linear_map_is_that_of_its_matrix(matrix, batch):
    shapes = [np.insert([size, 2], batch, 3) for size in matrix.shape[::-1]]
    x, cotangent = (_normal(seed, shape) for seed, shape in enumerate(shapes))
    mapped = jax.vmap(lambda x: maps.combine(matrix, x), batch, batch)
    (found,) = jax.vjp(mapped, x)[1](cotangent)
    contracted = 1 - batch
    expected = np.moveaxis(np.tensordot(matrix.T, cotangent, (1, contracted)), 0, contracted)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


CONTRACTIONS = [
    "nij,njk->nik",
    "nij,nj->ni",
    "ik,jk->ij",
    "cdv,cd->v",
    "cka,va->ckv",
    "i,i->",
    "ni,n->ni",
    "ija,aj->ji",
]
_SIZES = dict(zip("nijkcdva", (4, 3, 2, 5, 2, 3, 4, 6), strict=True))


def _factors(subscripts, *leading):
    first, second, _ = subscripts.replace("->", ",").split(",")
    shapes = [(*leading, *(_SIZES[letter] for letter in letters)) for letters in (first, second)]
    return [_normal(seed, shape) for seed, shape in enumerate(shapes)]


def _with_transposes(function, a, b, cotangent):
    value, pull = jax.vjp(function, a, b)
    return value, *pull(cotangent)


@pytest.mark.parametrize("subscripts", CONTRACTIONS)
@pytest.mark.parametrize("num_batches", [0, 2])
def test_a_contraction_and_its_derivatives_are_those_of_the_einstein_sum(subscripts, num_batches):
    """With both factors in the batch, or one of them."""
    leading = (3, 2)[:num_batches]
    left, right = subscripts.split("->")
    first, second = left.split(",")
    every = f"...{first},...{second}->...{right}"
    a, b = _factors(subscripts, *leading)
    for share_second in (False, True) if num_batches else (False,):
        other = b[(0,) * num_batches] if share_second else b
        mapped = functools.partial(maps.contract, subscripts)
        for _ in leading:
            mapped = jax.vmap(mapped, (0, None if share_second else 0))

        cotangent = _normal(2, np.einsum(every, a, other).shape)
        both = jax.jit(
            lambda *x, mapped=mapped: [
                _with_transposes(way, *x) for way in (mapped, functools.partial(jnp.einsum, every))
            ]
        )
        for one, two in zip(*both(a, other, cotangent), strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-12)


def test_a_sum_of_many_products_is_not_written_out():
    size = maps.LONGEST_SUM + 1
    a, b = jnp.ones((2, 3, size)), jnp.ones((2, size))
    mapped = jax.jit(jax.vmap(functools.partial(maps.contract, "ij,j->i")))
    np.testing.assert_array_equal(mapped(a, b), np.full((2, 3), size))
    assert "dot_general" in mapped.lower(a, b).as_text()
    assert "dot_general" not in mapped.lower(a[..., :-1], b[..., :-1]).as_text()


def _chain(x):
    """Return what sums of all three kinds, and operations between them, make of a state."""
    turned = 2.0 * spatial.cross(x, jnp.roll(x, 1, axis=0)) + 1.0
    return maps.contract("ni,ni->n", jnp.sin(maps.combine(np.tril(np.ones((4, 4))), turned)), x)


def test_on_a_cpu_the_batch_is_last_in_memory_from_one_sum_to_the_next():
    """In the program that is compiled, with its operations between them, and with their derivatives."""
    x = _normal(0, (32, 4, 3))
    compiled = jax.jit(jax.vmap(jax.value_and_grad(lambda x: _chain(x).sum()))).lower(x).compile().as_text()
    layouts = re.findall(r"= f64\[32,4,3\]\{([\d,]*)\} fusion", compiled)
    assert layouts.count("0,2,1") >= 3
    assert layouts.count("2,1,0") <= 1, "the gradient alone goes back to where it came from"


def test_a_program_that_is_shared_out_gathers_nothing():
    """XLA would, wherever a layout is asked for."""
    program = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import NamedSharding, Mesh, PartitionSpec as P
from tests.batched.test_maps import _chain
assert len(jax.devices()) == 4
sharding = NamedSharding(Mesh(np.array(jax.devices()), ("batch",)), P("batch"))
x = jax.device_put(jax.random.normal(jax.random.key(0), (32, 4, 3)), sharding)
shared = jax.jit(jax.vmap(jax.grad(lambda x: _chain(x).sum()))).lower(x).compile()
assert "all-gather" not in shared.as_text()
where = dict(mesh=sharding.mesh, in_specs=P("batch"), out_specs=P("batch"), check_vma=False)
apart = jax.shard_map(jax.vmap(jax.grad(lambda x: _chain(x).sum())), **where)
assert "{0,2,1}" in jax.jit(apart).lower(x).compile().as_text()
np.testing.assert_allclose(shared(x), jax.jit(apart)(x), rtol=1e-12)
"""
    run_python("-c", program, JAX_NUM_CPU_DEVICES="4", JAX_ENABLE_X64="1")


@pytest.mark.parametrize("length", [1, linear.LONGEST_SUM, linear.LONGEST_SUM + 1, 4 * linear.LONGEST_SUM + 3])
def test_an_inner_product_leaves_no_row_out(length):
    """Long ones are folded by halves, of which an odd row is left over."""
    random = np.random.default_rng(length)
    x, y = random.normal(size=(2, length, 3))
    # Rounding of so many terms of size one.
    np.testing.assert_allclose(linear.dot(jnp.asarray(x), jnp.asarray(y)), (x * y).sum(axis=0), atol=1e-13)
