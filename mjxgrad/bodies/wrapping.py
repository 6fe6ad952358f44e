"""Tendons on spheres and cylinders: points of contact and wrapped lengths.

MJX has NaN derivatives where a tendon's end lies on the axis, and on short arcs, whose cosine rounding puts at one. Inside a
ring it takes five steps of a search that needs up to twenty.

A tendon through a ring (its sidesite lies within) bends at the point e of the ring where its path is shortest, unless its
straight line passes too. With a and b its ends, a/|a - e| + b/|b - e| points along e there. The point is bracketed between
the limits of both ends' view. Two Newton steps, which are differentiated, give the root with its first and second derivative.
Within some 0.001 rad of the tendon leaving the ring C MuJoCo gives up and takes the middle of both ends.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float

from mjxgrad.batched.maps import safe_norm
from mjxgrad.bodies.spatial import normalise

_Point = Float[Array, "3"]
_Scalar = Float[Array, ""]
_HALVINGS = 40
# Slope (a pure number of order one) below which a tendon only grazes the ring: the point has no derivative there.
_FLAT = 1e-6


def wrap(wrap_circle: Callable, x0, x1, xpos, xmat, size, side, has_side, is_sphere, is_inside: bool, *_):
    """Return the length on a geom, -1 where the tendon does not touch it, and its first and last point there.

    A replacement of MJX's `support.wrap`, with its arguments after the first, which is MJX's wrap round a circle in the plane.
    """
    p0, p1, side = (xmat.T @ (x - xpos) for x in (x0, x1, side))
    if is_inside:
        in_plane = jnp.where(is_sphere, 1.0, jnp.array([1.0, 1.0, 0.0]))
        does_wrap, point = _inside(in_plane * p0, in_plane * p1, size)
        length, ends = jnp.zeros_like(size), (point, point)
    else:
        axes = jnp.where(is_sphere, _plane(p0, p1), jnp.eye(3)[:2])
        beside = normalise((axes @ side)[None])[0] * size
        length, flat = wrap_circle(jnp.concatenate([axes @ p0, axes @ p1]), beside, has_side, size)
        length = length.reshape(())
        does_wrap, ends = length >= 0, (flat[:2] @ axes, flat[2:] @ axes)
    # On a cylinder the tendon climbs at a constant rate.
    before, after = (safe_norm((p - end)[:2]) for p, end in zip((p0, p1), ends, strict=True))
    whole = jnp.where(does_wrap, before + length + after, 1.0)
    heights = [p0[2] + (p1[2] - p0[2]) * way / whole for way in (before, before + length)]
    climb = safe_norm(jnp.stack([length, heights[1] - heights[0]]))
    length = jnp.where(does_wrap, jnp.where(is_sphere, length, climb), -1.0)
    ends = (jnp.where(is_sphere, end, end.at[2].set(z)) for end, z in zip(ends, heights, strict=True))
    first, last = (jnp.where(does_wrap, xmat @ end + xpos, 0.0) for end in ends)
    return length[None], first, last


def _plane(p0: _Point, p1: _Point) -> Float[Array, "2 3"]:
    """Return two axes of the plane through two points and the origin; of any such plane where they are collinear."""
    first = _unit(p0)
    normal = jnp.cross(first, _unit(p1))
    is_line = jnp.sum(normal**2) < _FLAT**2
    other = jnp.cross(first, jnp.where(jnp.arange(3) == jnp.argmin(jnp.abs(first)), 1.0, 0.0))
    return jnp.stack([first, jnp.cross(_unit(jnp.where(is_line, other, normal)), first)])


def _unit(x: _Point) -> _Point:
    """Return the direction of a vector; zero stays zero."""
    return normalise(x[None])[0]


def arc_length(p0: Float[Array, "2"], p1: Float[Array, "2"], ind: Array, rad: _Scalar) -> _Scalar:
    """Return the length of an arc from one point of a circle to another, clockwise or, for `ind` 0, anticlockwise.

    A replacement of MJX's `support._length_circle`.
    """
    across, along = p0[1] * p1[0] - p0[0] * p1[1], p0 @ p1
    across = jnp.where(ind == 0, across, -across)
    is_point = across**2 + along**2 < mujoco.mjMINVAL**2
    angle = jnp.arctan2(across, jnp.where(is_point, 1.0, along))
    return rad * jnp.where(across < 0, angle + 2 * jnp.pi, angle)


def _inside(a: _Point, b: _Point, radius: _Scalar) -> tuple[Bool[Array, ""], _Point]:
    """Return whether a tendon inside a ring touches it, and the point, in the plane of both ends and the centre."""
    does_touch = _bends(*jax.lax.stop_gradient((a, b, radius)))
    # Where it does not touch, a solvable case avoids division by zero.
    a, b = (jnp.where(does_touch, p, 2 * radius * axis) for p, axis in zip((a, b), jnp.eye(3), strict=False))
    start = _unit(a)
    across = _unit(b) - start

    def at(share: _Scalar) -> _Point:
        return _unit(start + share * across)

    def gain(share: _Scalar) -> _Scalar:
        """Return the rate at which the path gets shorter as the point moves towards b."""
        e = at(share)
        pull = a / safe_norm(a - radius * e) + b / safe_norm(b - radius * e)
        return pull @ (across - e * (e @ across))

    def halve(_, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = 0.5 * (low + high)
        # A point hidden from an end is too far from it.
        unseen = [p @ at(middle) < radius for p in (a, b)]
        is_short = unseen[1] | (~unseen[0] & (gain(middle) > 0))
        return jnp.where(is_short, middle, low), jnp.where(is_short, high, middle)

    share = sum(jax.lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros_like(radius), jnp.ones_like(radius)))) / 2
    share = jax.lax.stop_gradient(share)
    for _ in range(2):
        value, slope = jax.jvp(gain, (share,), (jnp.ones_like(share),))
        is_curved = slope < -_FLAT
        share = share - jnp.where(is_curved, value / jnp.where(is_curved, slope, -1.0), 0.0)
    return does_touch, radius * at(share)  # pyright: ignore[reportArgumentType]


def _bends(a: _Point, b: _Point, radius: _Scalar) -> Bool[Array, ""]:
    """Return whether both ends lie outside the ring and their straight line does not meet it."""
    apart = b - a
    square = jnp.sum(apart**2)
    share = -(apart @ a) / jnp.maximum(square, mujoco.mjMINVAL)
    misses = (share <= 0) | (share >= 1) | (safe_norm(a + share * apart) > radius)
    return misses & (safe_norm(a) > radius) & (safe_norm(b) > radius)
