"""Rotations, cross products and inertias of many bodies at once.

Motions are (angular, linear), forces (torque, force), about one point for a whole kinematic tree and in world axes. All
functions but `multiply` take one leading axis of items.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.dynamics.bilinear import Bilinear

_CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
# Entries of a symmetric matrix in the order in which MuJoCo keeps those of an inertia.
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _cross_table() -> np.ndarray:
    table = np.zeros((3, 3, 3))
    for i, j, k in _CYCLES:
        table[k, i, j], table[k, j, i] = 1, -1
    return table


def _quaternion_table() -> np.ndarray:
    """Return the table of the Hamilton product of (w, x, y, z)."""
    table = np.zeros((4, 4, 4))
    table[1:, 1:, 1:] = _CROSS
    for i in range(4):
        table[i, 0, i] = table[i, i, 0] = 1
        table[0, i, i] = 1 if i == 0 else -1
    return table


def _rotation_table() -> np.ndarray:
    """Return the table of the matrix of v ↦ q v q*, with each pair of entries of q once."""
    conjugate = np.array([1, -1, -1, -1])
    turned = np.einsum("man,nlb,b->malb", QUATERNION, QUATERNION, conjugate)
    table = turned[1:, :, 1:].transpose(0, 2, 1, 3).reshape(9, 4, 4)
    return np.triu(table + np.tril(table, -1).transpose(0, 2, 1))


def _motion_table() -> np.ndarray:
    """Return the table of v × m = (ω × m_ω, ω × m_v + v × m_ω)."""
    table = np.zeros((6, 6, 6))
    table[:3, :3, :3] = table[3:, :3, 3:] = table[3:, 3:, :3] = _CROSS
    return table


def _momentum_table() -> np.ndarray:
    """Return the table of inertia times motion, (I ω + h × v, m v - h × ω), h the mass times its offset."""
    table = np.zeros((6, 10, 6))
    for entry, (i, j) in enumerate(_ENTRIES):
        table[i, entry, j] = table[j, entry, i] = 1
    table[:3, 6:9, 3:] = _CROSS
    table[3:, 6:9, :3] = -_CROSS
    table[3:, 9, 3:] = np.eye(3)
    return table


def _steiner_table() -> np.ndarray:
    """Return the table of |o|² m - o (m o)ᵀ, as entries, from o and m o."""
    table = np.zeros((6, 3, 3))
    for entry, (i, j) in enumerate(_ENTRIES):
        table[entry, i, j] -= 1
        if i == j:
            table[entry] += np.eye(3)
    return table


_CROSS = _cross_table()
QUATERNION = _quaternion_table()
_cross = Bilinear(_CROSS)
_multiply = Bilinear(QUATERNION)
_rotation = Bilinear(_rotation_table())
_cross_motion = Bilinear(_motion_table())
_cross_force = Bilinear(-_motion_table().transpose(2, 1, 0))
_momentum = Bilinear(_momentum_table())
_steiner = Bilinear(_steiner_table())


def contract(subscripts: str, *factors: Array) -> Array:
    """Return an Einstein sum at full precision."""
    return jnp.einsum(subscripts, *factors, precision="highest")


def combine(matrix: np.ndarray, x: Float[Array, "n *item"]) -> Float[Array, "m *item"]:
    """Return the sums over items that the rows of a constant matrix ask for."""
    if matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(len(matrix))):
        return x
    return jnp.tensordot(jnp.asarray(matrix, x.dtype), x, axes=1, precision="highest")


def pick(index: np.ndarray, x: Float[Array, "n *item"], default: np.ndarray | float = 0.0) -> Float[Array, "m *item"]:
    """Return the items of a constant index, and a default where it is negative.

    A product with a 0/1 matrix, not a gather: its transpose is no scatter, which XLA's CPU back end does one by one.
    """
    selected = combine(index[:, None] == np.arange(len(x)), x)
    if (index >= 0).all() or not np.any(default):
        return selected
    missing = (index < 0).reshape((-1,) + (1,) * (x.ndim - 1))
    return selected + jnp.asarray(missing * default, x.dtype)


def dot(a: Float[Array, "n k"], b: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Return the scalar product of each item."""
    return Bilinear(np.eye(a.shape[1])[None])(a, b)[:, 0]


def scale(factor: Float[Array, " n"], x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return items times a factor each."""
    return _scale(factor, x)


@jax.custom_jvp
def _scale(factor: Float[Array, " n"], x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    return factor[:, None] * x


@_scale.defjvp
def _scale_jvp(primals, tangents):
    (factor, x), (change, dx) = primals, tangents
    scaled = Bilinear(np.eye(x.shape[1])[:, None])
    return _scale(factor, x), scaled(change[:, None], x) + scaled(factor[:, None], dx)


def rotate(matrix: Float[Array, "n 3 3"], x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return matrix times vector of each item."""
    return contract("nij,nj->ni", matrix, x)


def compose(p: Float[Array, "n 3 3"], q: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """Return the matrix product of each item.

    Written out for the value, as a sum of outer products that XLA fuses into one loop, where its product of small matrices
    takes a tenth of a step longer (CPU); a product for the derivative, which written out is longer to compile.
    """
    return _compose(p, q)


@jax.custom_jvp
def _compose(p: Float[Array, "n 3 3"], q: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    return p[:, :, :1] * q[:, :1] + p[:, :, 1:2] * q[:, 1:2] + p[:, :, 2:] * q[:, 2:]


@_compose.defjvp
def _compose_jvp(primals, tangents):
    (p, q), (dp, dq) = primals, tangents
    return _compose(p, q), contract("nij,njk->nik", dp, q) + contract("nij,njk->nik", p, dq)


def cross(a: Float[Array, "n 3"], b: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return a × b."""
    return _cross(a, b)


def multiply(p: Float[Array, "*#batch 4"], q: Float[Array, "*#batch 4"]) -> Float[Array, "*#batch 4"]:
    """Return the Hamilton product p q of quaternions (w, x, y, z); leading axes of any number are broadcast."""
    dtype = jnp.result_type(p, q)
    return _multiply(*jnp.broadcast_arrays(jnp.asarray(p, dtype), jnp.asarray(q, dtype)))


def rotation_matrix(q: Float[Array, "n 4"]) -> Float[Array, "n 3 3"]:
    """Return the matrix of v ↦ q v q*, a rotation if q has norm one; quadratic in q whatever its norm."""
    return _rotation(q, q).reshape(-1, 3, 3)


def normalise(q: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return items of norm one; zero stays zero, with derivative one."""
    square = dot(q, q)
    return scale(jax.lax.rsqrt(jnp.where(square == 0, 1.0, square)), q)


def cross_motion(v: Float[Array, "n 6"], motion: Float[Array, "n 6"]) -> Float[Array, "n 6"]:
    """Return v × motion, the rate of a motion fixed to a body of velocity v."""
    return _cross_motion(v, motion)


def cross_force(v: Float[Array, "n 6"], force: Float[Array, "n 6"]) -> Float[Array, "n 6"]:
    """Return v ×* force, the rate of a force fixed to a body of velocity v; -(v ×)ᵀ force."""
    return _cross_force(v, force)


def momentum(inertia: Float[Array, "n 10"], motion: Float[Array, "n 6"]) -> Float[Array, "n 6"]:
    """Return inertia times motion."""
    return _momentum(inertia, motion)


def inertia_about(
    offset: Float[Array, "n 3"], mass: Float[Array, " n"], central: Float[Array, "n 3 3"]
) -> Float[Array, "n 10"]:
    """Return the inertia about a point.

    Args:
        offset: from the point to the centre of mass (m).
        mass: of each body (kg).
        central: rotational inertia about the centre of mass, in world axes (kg m²).

    Returns:
        Rotational inertia about the point (xx, yy, zz, xy, xz, yz), mass times offset, and mass.
    """
    moment = scale(mass, offset)
    flat = central.reshape(-1, 9)
    entries = jnp.concatenate([flat[:, ::4], flat[:, 1:3], flat[:, 5:6]], axis=1)
    return jnp.concatenate([entries + _steiner(offset, moment), moment, mass[:, None]], axis=1)
