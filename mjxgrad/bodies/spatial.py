"""Rotations, cross products and inertias of many bodies at once.

Motions are (angular, linear), forces (torque, force), about one point for a whole kinematic tree and in world axes. All
functions except those of quaternions take one leading axis of items.

**At rest.** The exponential map is analytic in the squared angle, and is written so, with a series where the closed form
divides by zero. Its derivative at zero angular velocity is then exact (half the time step); a guarded norm would lose it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.batched.maps import Bilinear, contract, dot, scale

_Quaternions = Float[Array, "*batch 4"]
_Matrices = Float[Array, "n 3 3"]
_Vectors = Float[Array, "n 3"]

_SERIES = 1e-4  # below this squared angle the truncated series are exact to double precision
# Squared length below which a vector has no direction: its power -3/2 in the derivative must be finite in single precision.
_NOTHING = 1e-20
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of a symmetric matrix, in MuJoCo's order of an inertia

# Tables of bilinear maps.
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(2, 0, 1)
QUATERNION = np.zeros((4, 4, 4))  # of the Hamilton product of (w, x, y, z)
QUATERNION[1:, 1:, 1:] = _CROSS
QUATERNION[range(4), 0, range(4)] = QUATERNION[range(4), range(4), 0] = 1
QUATERNION[0, range(4), range(4)] = 1, -1, -1, -1
# The matrix of v ↦ q v q*; each pair of entries of q occurs once.
_turned = np.einsum("man,nlb,b->malb", QUATERNION, QUATERNION, np.array([1, -1, -1, -1]))
_turned = _turned[1:, :, 1:].transpose(0, 2, 1, 3).reshape(9, 4, 4)
_ROTATION = np.triu(_turned + np.tril(_turned, -1).transpose(0, 2, 1))
_MOTION = np.zeros((6, 6, 6))  # v × m = (ω × m_ω, ω × m_v + v × m_ω)
_MOTION[:3, :3, :3] = _MOTION[3:, :3, 3:] = _MOTION[3:, 3:, :3] = _CROSS
_MOMENTUM = np.zeros((6, 10, 6))  # inertia times motion, (I ω + h × v, m v - h × ω), h the mass times its offset
for _entry, (_i, _j) in enumerate(_ENTRIES):
    _MOMENTUM[_i, _entry, _j] = _MOMENTUM[_j, _entry, _i] = 1
_MOMENTUM[:3, 6:9, 3:], _MOMENTUM[3:, 6:9, :3], _MOMENTUM[3:, 9, 3:] = _CROSS, -_CROSS, np.eye(3)

cross = Bilinear(_CROSS)
"""a × b."""
_multiply = Bilinear(QUATERNION)
_rotation = Bilinear(_ROTATION)
cross_motion = Bilinear(_MOTION)
"""v × motion, the rate of a motion fixed to a body of velocity v."""
cross_force = Bilinear(-_MOTION.transpose(2, 1, 0))
"""v ×* force, the rate of a force fixed to a body of velocity v; -(v ×)ᵀ force."""
momentum = Bilinear(_MOMENTUM)
"""Inertia times motion."""
# |o|² m - o (m o)ᵀ, as entries, from o and m o.
_steiner = Bilinear(np.array([(i == j) * np.eye(3) - np.outer(np.eye(3)[i], np.eye(3)[j]) for i, j in _ENTRIES]))


def rotate(matrix: _Matrices, x: _Vectors) -> _Vectors:
    """Return the product of matrix and vector, item by item."""
    return contract("nij,nj->ni", matrix, x)


@jax.custom_jvp
def compose(p: _Matrices, q: _Matrices) -> _Matrices:
    """Return the matrix product, item by item."""
    # The value is a sum of outer products, which XLA fuses into one loop; its product of small matrices would make a
    # step a tenth longer on a CPU. The derivative is a product, since it takes longer to compile when written out.
    return p[:, :, :1] * q[:, :1] + p[:, :, 1:2] * q[:, 1:2] + p[:, :, 2:] * q[:, 2:]


@compose.defjvp
def _compose_jvp(primals, tangents):
    (p, q), (dp, dq) = primals, tangents
    return compose(p, q), contract("nij,njk->nik", dp, q) + contract("nij,njk->nik", p, dq)


def multiply(p: Float[Array, "*#batch 4"], q: Float[Array, "*#batch 4"]) -> Float[Array, "*#batch 4"]:
    """Return the Hamilton product p q of quaternions (w, x, y, z); leading axes are broadcast."""
    dtype = jnp.result_type(p, q)
    return _multiply(*jnp.broadcast_arrays(jnp.asarray(p, dtype), jnp.asarray(q, dtype)))


def rotation_matrix(q: Float[Array, "n 4"]) -> _Matrices:
    """Return the matrix of v ↦ q v q*, quadratic in q; a rotation if q has norm one."""
    return _rotation(q, q).reshape(-1, 3, 3)


def normalise(q: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return items scaled to norm one; items shorter than 1e-10 keep their value, with derivative one."""
    square = dot(q, q)
    return scale(jax.lax.rsqrt(jnp.where(square < _NOTHING, 1.0, square)), q)


def inertia_about(offset: _Vectors, mass: Float[Array, " n"], central: _Matrices) -> Float[Array, "n 10"]:
    """Return the inertia about a point: (xx, yy, zz, xy, xz, yz), mass times offset from the point, and mass."""
    # `central` is the rotational inertia about the centre of mass, in world axes (kg m²).
    moment = scale(mass, offset)
    flat = central.reshape(-1, 9)
    entries = jnp.concatenate([flat[:, ::4], flat[:, 1:3], flat[:, 5:6]], axis=1)
    return jnp.concatenate([entries + _steiner(offset, moment), moment, mass[:, None]], axis=1)


def conjugate(q: _Quaternions) -> _Quaternions:
    """Return the conjugate quaternion, the inverse rotation of a unit quaternion."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def exponential(rotation: Float[Array, "*batch 3"]) -> _Quaternions:
    """Return the unit quaternion of a rotation vector (axis times angle, rad)."""
    square = jnp.sum(rotation * rotation, axis=-1, keepdims=True)
    small = square < _SERIES
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    half_sinc = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(0.5 * angle) / angle)
    cosine = jnp.where(small, 1 - square / 8 + square**2 / 384, jnp.cos(0.5 * angle))
    return jnp.concatenate([cosine, half_sinc * rotation], axis=-1)


def logarithm(q: _Quaternions) -> Float[Array, "*batch 3"]:
    """Return the rotation vector (rad) of a unit quaternion, by the shorter turn."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    sine = jnp.sum(q[..., 1:] ** 2, axis=-1, keepdims=True)
    small = sine < _SERIES
    norm = jnp.sqrt(jnp.where(small, 1.0, sine))
    # angle / sin(angle / 2) as a series in sin² of the half angle, else in closed form.
    series = 2 + sine / 3 + 3 * sine**2 / 20 + 5 * sine**3 / 56
    scale = jnp.where(small, series, 2 * jnp.arctan2(norm, q[..., :1]) / norm)
    return scale * q[..., 1:]
