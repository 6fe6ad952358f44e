"""Cholesky solves, by each of the ways that the devices have."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.batched import cholesky

_WAYS = {"written out": cholesky.written_out, "in blocks": cholesky.in_blocks, "chosen": cholesky.cholesky_solve}


def _systems(size: int, num: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(size)
    roots = random.normal(size=(num, size, size))
    return roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(size), random.normal(size=(num, size))


@pytest.mark.parametrize("way", _WAYS.values(), ids=_WAYS)
@pytest.mark.parametrize(("size", "num"), [(1, 3), (5, 45), (18, 2)])
# Fewer than a warp; more, and no multiple of it; several blocks, the last one not full.
def test_solves_every_member_of_the_batch(way, size: int, num: int):
    matrices, vectors = _systems(size, num)
    found = jax.jit(way)(jnp.moveaxis(matrices, 0, -1), vectors.T)
    expected = np.linalg.solve(matrices, vectors[..., None])[..., 0].T
    # Conditions up to 1e3 times eps of double precision.
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_vectors_share_a_matrix():
    matrices, vectors = _systems(5, 7)
    found = jax.jit(cholesky.written_out)(matrices[0][..., None], vectors.T)
    np.testing.assert_allclose(found, np.linalg.solve(matrices[0], vectors.T), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("way", _WAYS.values(), ids=_WAYS)
def test_an_indefinite_member_is_not_finite_and_its_neighbour_is_right(way):
    matrices, vectors = _systems(6, 2)
    matrices[0, 5, 5] = -100.0
    found = jax.jit(way)(jnp.moveaxis(matrices, 0, -1), vectors.T)
    assert not np.isfinite(found[:, 0]).any()
    np.testing.assert_allclose(found[:, 1], np.linalg.solve(matrices[1], vectors[1]), rtol=1e-10)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere LAPACK has no part")
def test_no_batch_goes_to_lapack():
    # jaxlib 0.10 hangs where as many programs hand it a batch as there are threads.
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for _ in range(cholesky._LARGEST // 3 + 1):
        body = body.add_body(pos=[0, 0, -0.1])
        for axis in np.eye(3):
            body.add_joint(axis=axis, damping=[0.1, 0, 0], range=[-1, 1], limited=True)
        body.add_geom(size=[0.02, 0, 0])
    scene = mg.load_scene(spec.compile())

    def cost(qvel):
        return jnp.sum(mg.rollout(scene, mg.initial_state(scene, qvel=qvel), horizon=2).qpos[-1])

    qvel = jnp.zeros((2, scene.model.nv))
    program = jax.jit(jax.vmap(jax.value_and_grad(cost))).lower(qvel)
    assert "@lapack" not in program.as_text()
