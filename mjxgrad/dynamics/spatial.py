"""Rotations, cross products and inertias as products with constant tables.

Every operation here is bilinear. It is written as one product with a constant table, which arranges the first factor as
a small matrix, and one product of that matrix with the second factor. The derivatives of matrix products are matrix products, so
reverse mode needs no more than twice the instructions of the function. Written in components, as `jnp.cross` is, the same
derivative is a sum of padded slices, which XLA fuses by computing the inputs again for each of them.

Motions are (angular, linear), forces (torque, force), about one point for a whole kinematic tree and in world axes. All
functions take one leading axis of items.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def _quaternion_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return tables L, R with p q = L(p) q and p q = R(q) p."""
    left = np.zeros((4, 4, 4))
    for i in range(4):
        left[0, i, i] = 1
    for i in (1, 2, 3):
        left[i, i, 0], left[i, 0, i] = 1, -1
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        left[i, k, j], left[j, k, i] = 1, -1
    return left, left.transpose(2, 1, 0)


def _motion_table(cross: np.ndarray) -> np.ndarray:
    """Return the table of v × m: (ω × m_ω, ω × m_v + v × m_ω)."""
    table = np.zeros((6, 6, 6))
    table[:3, :3, :3] = table[:3, 3:, 3:] = table[3:, 3:, :3] = cross
    return table


def _inertia_table(cross: np.ndarray) -> np.ndarray:
    """Return the 6 × 6 matrix of an inertia (xx, yy, zz, xy, xz, yz, m c, m)."""
    table = np.zeros((10, 6, 6))
    for entry, (i, j) in enumerate(_ENTRIES):
        table[entry, i, j] = table[entry, j, i] = 1
    table[6:9, :3, 3:] = cross
    table[6:9, 3:, :3] = -cross
    table[9, 3:, 3:] = np.eye(3)
    return table


def _offset_table() -> np.ndarray:
    """Return the table from (inertia about the centre of mass, m o oᵀ, m o, m) to an inertia, o the centre of mass."""
    table = np.zeros((22, 10))
    for entry, (i, j) in enumerate(_ENTRIES):
        table[3 * i + j, entry] = 1
        table[9 + 3 * i + j, entry] -= 1
        if i == j:  # m |o|² on the diagonal
            table[[9, 13, 17], entry] += 1
    table[18:, 6:] = np.eye(4)
    return table


_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_LEFT, _RIGHT = _quaternion_tables()
_CONJUGATE = np.diag([1.0, -1.0, -1.0, -1.0])
# q v q* in two halves: the imaginary rows of L(q) and the imaginary columns of R(q*).
_ROTATION = np.concatenate(
    [
        _LEFT[:, 1:].reshape(4, 12),
        _CONJUGATE @ _RIGHT[:, :, 1:].reshape(4, 12),
    ],
    axis=1,
)
_CROSS = _LEFT[1:, 1:, 1:]
_MOTION = _motion_table(_CROSS)
_INERTIA = _inertia_table(_CROSS)
_OFFSET = _offset_table()


def contract(subscripts: str, *factors: Array) -> Array:
    """Return an Einstein sum at full precision."""
    return jnp.einsum(subscripts, *factors, precision="highest")


def combine(matrix: np.ndarray, x: Float[Array, "n *item"]) -> Float[Array, "m *item"]:
    """Return the sums over items that the rows of a constant matrix ask for."""
    if matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(len(matrix))):
        return x
    return jnp.tensordot(jnp.asarray(matrix, x.dtype), x, axes=1, precision="highest")


def pick(
    index: np.ndarray, x: Float[Array, "n *item"], default: np.ndarray | float = 0.0
) -> Float[Array, "m *item"]:
    """Return the items of a constant index, and a default where it is negative.

    A product with a 0/1 matrix, not a gather: its transpose is no scatter, which XLA's CPU back end does one by one.
    """
    selected = combine(index[:, None] == np.arange(len(x)), x)
    if (index >= 0).all() or not np.any(default):
        return selected
    missing = (index < 0).reshape((-1,) + (1,) * (x.ndim - 1))
    return selected + jnp.asarray(missing * default, x.dtype)


def _arrange(x: Float[Array, "n a"], table: np.ndarray) -> Float[Array, "n b c"]:
    flat = jnp.asarray(table.reshape(len(table), -1), x.dtype)
    return jnp.matmul(x, flat, precision="highest").reshape(-1, *table.shape[1:])


def scale(factor: Float[Array, " n"], x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return items times a factor each."""
    return contract("n,nk->nk", factor, x)


def rotate(matrix: Float[Array, "n 3 3"], x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return matrix times vector of each item."""
    return contract("nij,nj->ni", matrix, x)


def compose(p: Float[Array, "n 3 3"], q: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """Return the matrix product of each item."""
    return contract("nij,njk->nik", p, q)


def cross(a: Float[Array, "n 3"], b: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return a × b."""
    return rotate(_arrange(a, _CROSS), b)


def multiply(p: Float[Array, "n 4"], q: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """Return the Hamilton product p q of quaternions (w, x, y, z)."""
    return contract("nij,nj->ni", _arrange(p, _LEFT), q)


def rotation_matrix(q: Float[Array, "n 4"]) -> Float[Array, "n 3 3"]:
    """Return v ↦ q v q*, the rotation of a unit quaternion; quadratic in q whatever its norm."""
    halves = jnp.matmul(q, jnp.asarray(_ROTATION, q.dtype), precision="highest")
    left, right = halves[:, :12].reshape(-1, 3, 4), halves[:, 12:].reshape(-1, 4, 3)
    return contract("nij,njk->nik", left, right)


def normalise(q: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return items of norm one; zero stays zero, with derivative one."""
    square = contract("nk,nk->n", q, q)
    is_zero = square == 0
    return scale(jax.lax.rsqrt(jnp.where(is_zero, 1.0, square)), q)


def cross_motion(v: Float[Array, "n 6"], motion: Float[Array, "n 6"]) -> Float[Array, "n 6"]:
    """Return v × motion, the rate of a motion fixed to a body of velocity v."""
    return contract("nij,nj->ni", _arrange(v, _MOTION), motion)


def cross_force(v: Float[Array, "n 6"], force: Float[Array, "n 6"]) -> Float[Array, "n 6"]:
    """Return v ×* force, the rate of a force fixed to a body of velocity v; -(v ×)ᵀ force."""
    return -contract("nji,nj->ni", _arrange(v, _MOTION), force)


def inertia_matrix(inertia: Float[Array, "n 10"]) -> Float[Array, "n 6 6"]:
    """Return the matrix from motion to momentum."""
    return _arrange(inertia, _INERTIA)


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
    second = contract("ni,nj->nij", moment, offset)
    parts = [central.reshape(-1, 9), second.reshape(-1, 9), moment, mass[:, None]]
    return jnp.matmul(
        jnp.concatenate(parts, axis=1), jnp.asarray(_OFFSET, offset.dtype), precision="highest"
    )
