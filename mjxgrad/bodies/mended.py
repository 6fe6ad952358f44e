"""Copies of MJX's functions with finite derivatives; MJX itself is not changed.

Guards that keep a value finite do not always keep its derivative finite. `x + eps * (x == 0)` lets 1e-21 through, and the
derivative of a quotient divides by its square, which overflows in single precision. Infinity times the zero of a branch not
taken is NaN. This module copies the modules that hold such guards, replaces a few functions, and lets the copies call each
other. Values are MJX's to the bit, except where a guard acts and where the list says otherwise:

- `collision_convex`, in `contact.collision`: two quotients, where an edge meets a plane and where a face meets another.
- `support.muscle_dynamics_timescale`: the smooth switch, a quintic in a quotient by a width that is zero by default.
- `support.wrap`: see `wrapping`, with the values of C MuJoCo.
- `math.quat_to_axis_angle`: separate axis and angle have no derivative at rest, so servos lost theirs. Rounding differs.
- `math.safe_div`, `ray._ray_quad`: the distance along rays that run along a face, or miss a ball, had no derivative.
- `ray.ray`: it fails in a scene without materials.
"""

import importlib.util
import sys
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import safe_sqrt
from mjxgrad.bodies import spatial, wrapping

_Scalar = Float[Array, "..."]


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


def _muscle_dynamics_timescale(dctrl: _Scalar, tau_act: _Scalar, tau_deact: _Scalar, width: _Scalar) -> _Scalar:
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


# These modules use only the product of axis and angle.
_math = copy_of("math", quat_to_axis_angle=lambda q: (spatial.logarithm(q), 1.0), safe_div=_safe_div)
_support = copy_of(
    "support", muscle_dynamics_timescale=_muscle_dynamics_timescale, _length_circle=wrapping.arc_length, math=_math
)
_support.wrap = partial(wrapping.wrap, _support.wrap_circle)
_smooth = copy_of("smooth", math=_math, support=_support)
_forward = copy_of("forward", support=_support)
_ray = copy_of("ray", math=_math, _ray_quad=_ray_quad)
_ray.ray = partial(_cast, _ray.ray)
_sensor = copy_of("sensor", ray=_ray, smooth=_smooth, support=_support)

tendon, tendon_armature, tendon_bias = _smooth.tendon, _smooth.tendon_armature, _smooth.tendon_bias
transmission, fwd_actuation, euler = _smooth.transmission, _forward.fwd_actuation, _forward.euler
sensor_pos, sensor_vel, sensor_acc = _sensor.sensor_pos, _sensor.sensor_vel, _sensor.sensor_acc
