"""Copies of MJX's functions with finite derivatives; MJX itself is not changed.

Guards that keep a value finite do not always keep its derivative finite: that of a quotient divides by its square. This module
copies the modules that hold such guards, replaces a few functions, and lets the copies call each other. Values are MJX's to the
bit, except where a guard acts and where the list says otherwise:

- `collision_convex`, in `contact.collision`: two quotients, where an edge meets a plane and where a face meets another.
- `support.muscle_dynamics_timescale`: the smooth switch, a quintic in a quotient by a width that is zero by default.
- `support.wrap`: tendons on spheres and cylinders, with the values of C MuJoCo, also inside rings, where MJX's search is short.
- `math.quat_to_axis_angle`: separate axis and angle have no derivative at rest. Rounding differs.
- `math.safe_div`, `ray._ray_quad`: the distance along rays that run along a face, or miss a ball, had no derivative.
- `ray.ray`: it fails in a scene without materials.

A tendon through a ring (its sidesite lies within) bends at the point e of the ring where its path is shortest, unless its
straight line passes too. With a and b its ends, a/|a - e| + b/|b - e| points along e there. The point is bracketed between the
limits of both ends' view; two Newton steps, which are differentiated, give the root with its first and second derivative.
"""

import importlib.util
import sys
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import safe_norm, safe_sqrt
from mjxgrad.bodies import spatial

_Scalar = Float[Array, "..."]
_Point = Float[Array, "3"]
_HALVINGS = 40
# Slope (a pure number of order one) below which a tendon only grazes the ring: the point has no derivative there.
_FLAT = 1e-6


def copy_of(name: str, **replaced: Callable | ModuleType) -> ModuleType:
    """Return a copy of one of MJX's modules with some names replaced.

    Raises:
        ImportError: if the module has no such name, as in another release of MJX.
    """
    spec = sys.modules[f"mujoco.mjx._src.{name}"].__spec__
    module = importlib.util.module_from_spec(spec)  # pyright: ignore[reportArgumentType]
    spec.loader.exec_module(module)  # pyright: ignore[reportOptionalMemberAccess]
    if missing := replaced.keys() - vars(module).keys():
        raise ImportError(f"MJX's {name} must have {', '.join(sorted(missing))}: install mujoco-mjx 3.17")
    vars(module).update(replaced)
    return module


def _timescale(dctrl: _Scalar, tau_act: _Scalar, tau_deact: _Scalar, width: _Scalar) -> _Scalar:
    """Return the time constant of a muscle (s), which switches at once or over a width of the control."""
    is_hard = width < mujoco.mjMINVAL
    x = jnp.clip(dctrl / jnp.where(is_hard, 1.0, width) + 0.5, 0, 1)
    smooth = tau_deact + (tau_act - tau_deact) * (x * x * x * (3 * x * (2 * x - 5) + 10))
    return jnp.where(is_hard, jnp.where(dctrl > 0, tau_act, tau_deact), smooth)


def _safe_div(num: _Scalar, den: _Scalar) -> _Scalar:
    """Return a quotient; a denominator near zero is replaced by MuJoCo's smallest number with its sign."""
    return num / jnp.where(jnp.abs(den) >= mujoco.mjMINVAL, den, jnp.where(den < 0, -1, 1) * mujoco.mjMINVAL)


def _ray_quad(a: _Scalar, b: _Scalar, c: _Scalar) -> tuple[_Scalar, _Scalar]:
    """Return the non-negative solutions of a x² + 2 b x + c = 0, and infinity in place of others."""
    square = b * b - a * c
    is_real, root = square >= mujoco.mjMINVAL, safe_sqrt(square)
    found = (_safe_div(-b - root, a), _safe_div(-b + root, a))
    return tuple(jnp.where(is_real & (x >= 0), x, jnp.inf) for x in found)  # pyright: ignore[reportReturnType]


def _cast(ray: Callable, model: mjx.Model, *others: Any, **options: Any) -> Any:
    """Cast a ray, also in a scene without materials: MJX looks one up for every geom."""
    none = model if len(model.mat_rgba) else model.replace(mat_rgba=jnp.ones((1, 4)))
    return ray(none, *others, **options)


def _wrap(wrap_circle: Callable, x0, x1, xpos, xmat, size, side, has_side, is_sphere, is_inside: bool, *_):
    """Return the length on a geom, -1 where the tendon does not touch it, and its first and last point there."""
    # A replacement of MJX's `support.wrap`, with its arguments after the first, which is MJX's wrap round a circle in the plane.
    p0, p1, side = (xmat.T @ (x - xpos) for x in (x0, x1, side))
    if is_inside:
        in_plane = jnp.where(is_sphere, 1.0, jnp.array([1.0, 1.0, 0.0]))
        does_wrap, point = _inside(in_plane * p0, in_plane * p1, size)
        length, ends = jnp.zeros_like(size), (point, point)
    else:
        axes = jnp.where(is_sphere, _plane(p0, p1), jnp.eye(3)[:2])
        beside = spatial.normalise((axes @ side)[None])[0] * size
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
    return spatial.normalise(x[None])[0]


def _arc_length(p0: Float[Array, "2"], p1: Float[Array, "2"], ind: Array, rad: _Scalar) -> _Scalar:
    """Return the length of an arc from one point of a circle to another, clockwise or, for `ind` 0, anticlockwise."""
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


# These modules use only the product of axis and angle.
_math = copy_of("math", quat_to_axis_angle=lambda q: (spatial.logarithm(q), 1.0), safe_div=_safe_div)
_support = copy_of("support", muscle_dynamics_timescale=_timescale, _length_circle=_arc_length, math=_math)
_support.wrap = partial(_wrap, _support.wrap_circle)
_smooth = copy_of("smooth", math=_math, support=_support)
_forward = copy_of("forward", support=_support)
_ray = copy_of("ray", math=_math, _ray_quad=_ray_quad)
_ray.ray = partial(_cast, _ray.ray)
_sensor = copy_of("sensor", ray=_ray, smooth=_smooth, support=_support)

tendon, tendon_armature, tendon_bias = _smooth.tendon, _smooth.tendon_armature, _smooth.tendon_bias
transmission, fwd_actuation, euler = _smooth.transmission, _forward.fwd_actuation, _forward.euler
sensor_pos, sensor_vel, sensor_acc = _sensor.sensor_pos, _sensor.sensor_vel, _sensor.sensor_acc
