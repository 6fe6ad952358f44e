"""Rotations whose derivatives exist at rest.

The exponential map is analytic in the squared angle. Written so, with a series where the closed form divides by zero, it
has its true derivative at zero angular velocity (half the time step), where dividing by a guarded norm gives none.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.dynamics.spatial import multiply

# Below this squared angle the truncated series are exact to double precision: the first term left out of either is
# smaller than (1e-4)**3 / 46080 = 2e-17.
_SERIES = 1e-4


def conjugate(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Return the conjugate quaternion, the inverse rotation of a unit quaternion."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def exponential(rotation: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Return the unit quaternion of a rotation vector (axis times angle, rad)."""
    square = jnp.sum(rotation * rotation, axis=-1, keepdims=True)
    small = square < _SERIES
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    half_sinc = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(0.5 * angle) / angle)
    cosine = jnp.where(small, 1 - square / 8 + square**2 / 384, jnp.cos(0.5 * angle))
    return jnp.concatenate([cosine, half_sinc * rotation], axis=-1)


def logarithm(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3"]:
    """Return the rotation vector (rad) of a unit quaternion, of the shorter of the two turns."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    sine = jnp.sum(q[..., 1:] ** 2, axis=-1, keepdims=True)
    small = sine < _SERIES
    norm = jnp.sqrt(jnp.where(small, 1.0, sine))
    # angle / sin(angle / 2) as a series in sin² of the half angle, else in closed form.
    series = 2 + sine / 3 + 3 * sine**2 / 20 + 5 * sine**3 / 56
    scale = jnp.where(small, series, 2 * jnp.arctan2(norm, q[..., :1]) / norm)
    return scale * q[..., 1:]


def integrate(q: Float[Array, "*batch 4"], rotation: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Return q turned by a rotation vector in its own frame (rad), normalised."""
    turned = multiply(q, exponential(rotation))
    return turned / jnp.sqrt(jnp.sum(turned * turned, axis=-1, keepdims=True))
