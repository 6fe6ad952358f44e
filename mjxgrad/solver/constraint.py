r"""Laws of the constraint rows: cost, force and curvature as functions of x = J a - a_ref.

Rows come in MuJoCo's order: equality (½Dx²), friction loss (Huber, slope bounded by the loss), then limits and contacts (½D
min(x, 0)²), where an elliptic contact couples its rows in three zones. With u = (μx₀, f₁x₁, ...), N = u₀, T = |u₁..|:

- top, N ≥ μT: no cost;
- bottom, μN + T ≤ 0: ½ Σ D x²;
- middle: ½ D₀ (N - μT)² / (μ²(1 + μ²)), whose curvature in u is the sum of two positive parts, (1, -μτ)(1, -μτ)ᵀ and μ(μT - N)/T
  (I - ττᵀ), τ the unit tangent. (μT - N)/T is at most μ + 1/μ, so nothing needs clamping.

Rows under noise (see `smoothing`) have the mean of these costs, at x + c w over noise w on the distance. The mean of ½ min(x, 0)²
is convex in x, with the derivative -`_mean_violation`. A cone's cost is the sum of two such terms,

    ½ k min(N - μT, 0)² + ½ k min(μN + T, 0)²,        k = D₀ / (μ²(1 + μ²)),

each with a spread of its own, since noise shifts N by μcw. Arrays may carry the batch as trailing axes, see `linear`.

References:
    Todorov. Convex and analytically-invertible dynamics with contacts and constraints: Theory and implementation in
    MuJoCo. ICRA 2014. MuJoCo documentation, "Computation", "Constraint model".
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjxgrad.batched.linear import add, sum_of_few
from mjxgrad.solver.noise import KERNELS, Kernel

_PerRow = Float[Array, "rows *batch"]
_PerContact = Float[Array, "contacts *batch"]
_Directions = Float[Array, "contacts dim *batch"]
_Columns = Float[Array, "contacts dim columns *batch"]
_Law = tuple[Callable[[_PerRow], _Directions], Callable[[_Columns], _Columns]]


@dataclasses.dataclass(frozen=True)
class ConeGroup:
    """Elliptic contacts of one dimension, in consecutive rows."""

    start: int
    count: int
    dim: int

    @property
    def stop(self) -> int:
        return self.start + self.count * self.dim


@dataclasses.dataclass(frozen=True)
class RowLayout:
    """The law of each constraint row. Static: it shapes the compiled program."""

    num_equality: int
    num_friction: int
    num_rows: int
    cones: tuple[ConeGroup, ...] = ()
    first_noisy: int | None = None
    kernel: Kernel = KERNELS["gaussian"]  # of the noise, if there is any

    @property
    def friction(self) -> slice:
        return slice(self.num_equality, self.num_equality + self.num_friction)

    @property
    def simple_stop(self) -> int:
        """End of the uncoupled rows, those outside elliptic cones."""
        return self.cones[0].start if self.cones else self.num_rows

    @property
    def is_piecewise_quadratic(self) -> bool:
        """Whether the cost along a line is piecewise quadratic."""
        return not self.cones and self.first_noisy is None

    @property
    def hard_stop(self) -> int:
        """End of the uncoupled rows without noise; all later rows have noise, cones included."""
        return self.simple_stop if self.first_noisy is None else self.first_noisy


class Noise(eqx.Module):
    """The effect of noise on the distance r on x of the rows of contacts (m/s² or rad/s²); a cone uses its first row."""

    spread: _PerRow  # change of x when r changes by one length of the noise; positive
    gate: _PerRow  # x at which contact ends by distance and not by acceleration


class Rows(eqx.Module):
    """Parameters of the constraint rows of one state."""

    reference: _PerRow  # the reference acceleration a_ref (m/s² or rad/s²)
    weight: _PerRow  # D, the inverse of the regularisation R (kg or kg m²)
    bound: _PerRow  # largest force of a friction loss row (N or N m); unused by other rows
    scales: tuple[Float[Array, "_ _ *batch"], ...]  # (μ, f₁, f₂, ...) by contact and elliptic group; μ = f₁/√impratio
    noise: Noise | None = None  # noise on the rows, if the layout has noisy rows


def force(layout: RowLayout, rows: Rows, x: _PerRow) -> _PerRow:
    """Return the constraint forces, minus the derivative of the cost with respect to x (N or N m)."""
    hard, friction = slice(layout.friction.stop, layout.hard_stop), layout.friction
    linear = -rows.weight * x
    bound = rows.bound[friction]
    limit = jnp.sign(x[friction]) * bound
    # `where`, not `clip` and `maximum`: at a tie their derivative is one half, which belongs to neither side.
    parts = [
        linear[: friction.start],
        jnp.where(jnp.abs(linear[friction]) < bound, linear[friction], -limit),
        jnp.where(x[hard] < 0, linear[hard], 0.0),
    ]
    if layout.first_noisy is not None:
        noisy = slice(layout.hard_stop, layout.simple_stop)
        parts.append(rows.weight[noisy] * _mean_violation(layout.kernel, x[noisy], _noise_at(rows, noisy))[0])
    for k in range(len(layout.cones)):
        parts.append(_cone(layout, k, rows, x)[0](linear).reshape(-1, *x.shape[1:]))
    return jnp.concatenate([part for part in parts if part.shape[0]])


def bounds(layout: RowLayout, rows: Rows) -> tuple[_PerRow, _PerRow]:
    """Return the least and the largest force of uncoupled rows without noise; between them the force is -D x."""
    bound, one_sided = rows.bound[layout.friction], jnp.zeros_like(rows.bound[layout.friction.stop :])
    equality = jnp.full_like(rows.bound[: layout.num_equality], jnp.inf)
    low = jnp.concatenate([-equality, -bound, one_sided])
    return low, jnp.concatenate([equality, bound, jnp.full_like(one_sided, jnp.inf)])


class RowHessian(eqx.Module):
    """The second derivative of the cost by x: one number per uncoupled row, one matrix per elliptic contact."""

    simple: Float[Array, "_ *batch"]
    cones: tuple[Float[Array, "_ _ _ *batch"], ...]


def hessian(layout: RowLayout, rows: Rows, x: _PerRow) -> RowHessian:
    """Return the second derivative of the cost with respect to x."""
    cones = []
    for k, group in enumerate(layout.cones):
        unit = jnp.eye(group.dim, dtype=x.dtype).reshape(1, group.dim, group.dim, *(1,) * (x.ndim - 1))
        unit = jnp.broadcast_to(unit, (group.count, group.dim, group.dim, *x.shape[1:]))
        cones.append(_cone(layout, k, rows, x)[1](unit))
    return RowHessian(_simple_curvature(layout, rows, x), tuple(cones))


def hessian_product(layout: RowLayout, row_hessian: RowHessian, x: _PerRow) -> _PerRow:
    """Return the second derivative of the cost times a vector."""
    parts = [row_hessian.simple * x[: layout.simple_stop]]
    for group, matrix in zip(layout.cones, row_hessian.cones, strict=True):
        own = _blocks(group, x)
        both = add(matrix[:, :, k] * own[:, None, k] for k in range(group.dim))
        parts.append(both.reshape(-1, *x.shape[1:]))
    return jnp.concatenate(parts)


def curvature_product(
    layout: RowLayout, rows: Rows, x: _PerRow, matrix: Float[Array, "rows columns *batch"]
) -> Float[Array, "rows columns *batch"]:
    """Return the second derivative of the cost with respect to x, times a matrix."""
    parts = [_simple_curvature(layout, rows, x)[:, None] * matrix[: layout.simple_stop]]
    for k, group in enumerate(layout.cones):
        both = _cone(layout, k, rows, x)[1](_blocks(group, matrix))
        parts.append(both.reshape(-1, *matrix.shape[1:]))
    return jnp.concatenate(parts, axis=0)


def _simple_curvature(layout: RowLayout, rows: Rows, x: _PerRow) -> Float[Array, "_ *batch"]:
    hard, friction = slice(layout.friction.stop, layout.hard_stop), layout.friction
    stuck = jnp.abs(rows.weight[friction] * x[friction]) < rows.bound[friction]
    equality = jnp.ones_like(x[: friction.start], bool)
    is_curved = jnp.concatenate([equality, stuck, x[hard] < 0])
    curvature = jnp.where(is_curved, rows.weight[: layout.hard_stop], 0.0)
    if layout.first_noisy is None:
        return curvature
    noisy = slice(layout.hard_stop, layout.simple_stop)
    probability = _mean_violation(layout.kernel, x[noisy], _noise_at(rows, noisy))[1]
    return jnp.concatenate([curvature, rows.weight[noisy] * probability])


def _cone(layout: RowLayout, which: int, rows: Rows, x: _PerRow) -> _Law:
    """Return the force of an elliptic group, a function of -D x, and the product of its curvature and columns."""
    group, scale = layout.cones[which], rows.scales[which]
    u = _blocks(group, x) * scale
    square = sum_of_few(u[:, 1:] ** 2)[:, 0]
    slides = square > 1e-24  # m²/s⁴; less is rest, without a direction whose derivative could overflow
    slip = jnp.where(slides, jnp.sqrt(jnp.where(slides, square, 1.0)), 0.0)
    mu = scale[:, 0]
    stiffness = rows.weight[group.start : group.stop : group.dim] / (mu**2 * (1 + mu**2))
    if layout.first_noisy is not None:
        noise = _noise_at(rows, slice(group.start, group.stop, group.dim))
        return _noisy_cone(layout.kernel, noise, scale, u, slip, stiffness)
    normal, tangent = u[:, 0], u[:, 1:] / jnp.where(slides, slip, 1.0)[:, None]
    is_top, gap = normal >= mu * slip, normal - mu * slip
    is_bottom = ~is_top & (mu * normal + slip <= 0)
    is_middle = ~is_top & ~is_bottom

    def force(linear: _PerRow) -> _Directions:
        press = jnp.where(is_middle, -stiffness * gap, 0.0)
        slide = -(press * mu)[:, None] * tangent
        middle = scale * jnp.concatenate([press[:, None], slide], axis=1)
        return jnp.where(is_bottom[:, None], _blocks(group, linear), middle)

    def product(block: _Columns) -> _Columns:
        scaled = scale[:, :, None] * block
        along = jnp.concatenate([jnp.ones_like(mu)[:, None], -mu[:, None] * tangent], axis=1)
        ratio = jnp.where(is_middle, -gap / jnp.where(slip > 0, slip, 1.0), 0.0)
        first = along[:, :, None] * sum_of_few(along[:, :, None] * scaled)
        slide = sum_of_few(tangent[:, :, None] * scaled[:, 1:])
        across = scaled[:, 1:] - tangent[:, :, None] * slide
        second = jnp.concatenate([jnp.zeros_like(scaled[:, :1]), (mu * ratio)[:, None, None] * across], axis=1)
        middle = (stiffness[:, None] * scale)[:, :, None] * (first + second)
        bottom = _blocks(group, rows.weight)[:, :, None] * block
        return jnp.where(is_bottom[:, None, None], bottom, jnp.where(is_middle[:, None, None], middle, 0.0))

    return force, product


def _noisy_cone(
    kernel: Kernel, noise: Noise, scale: _Directions, u: _Directions, slip: _PerContact, stiffness: _PerContact
) -> _Law:
    """Return the same under noise, from the two terms of the cost in the coordinates u."""
    mu, normal, tangential = scale[:, 0], u[:, 0], u[:, 1:]
    first = Noise(mu * noise.spread, mu * noise.gate)
    second = Noise(mu * first.spread, mu * first.gate)
    violation1, share1 = _mean_violation(kernel, normal - mu * slip, first)
    violation2, share2 = _mean_violation(kernel, mu * normal + slip, second)
    # The tangential force per slip. At small slip the two terms nearly cancel. There the mean of the derivative over the slip is
    # taken instead, by the trapezoidal rule: its second-order error equals rounding at the cube root of eps.
    still = _mean_violation(kernel, normal, first)[1]
    smallest = (12 * jnp.finfo(u.dtype).eps) ** (1 / 3) * jnp.minimum(noise.spread, second.spread)
    is_small = slip < smallest
    moving = (mu * violation1 - violation2) / jnp.where(is_small, 1.0, slip)
    hold = jnp.where(is_small, 0.5 * (mu**2 * (share1 + still) + share2 + still), moving)

    def force(_: _PerRow) -> _Directions:
        press = violation1 + mu * violation2
        both = jnp.concatenate([press[:, None], -hold[:, None] * tangential], axis=1)
        return stiffness[:, None] * scale * both

    def product(block: _Columns) -> _Columns:
        scaled = scale[:, :, None] * block
        ratio = scale[:, :1, None]
        tangent = (tangential / jnp.where(slip > 0, slip, 1.0)[:, None])[:, :, None]
        slide = sum_of_few(tangent * scaled[:, 1:])
        one = share1[:, None, None] * (scaled[:, :1] - ratio * slide)
        other = share2[:, None, None] * (ratio * scaled[:, :1] + slide)
        across = hold[:, None, None] * (scaled[:, 1:] - tangent * slide)
        along = tangent * (other - ratio * one)
        both = jnp.concatenate([one + ratio * other, along + across], axis=1)
        return (stiffness[:, None] * scale)[:, :, None] * both

    return force, product


def _blocks(group: ConeGroup, x: Float[Array, "rows *rest"]) -> Float[Array, "contacts dim *rest"]:
    return x[group.start : group.stop].reshape(group.count, group.dim, *x.shape[1:])


def _noise_at(rows: Rows, which: slice) -> Noise:
    assert rows.noise is not None
    return Noise(rows.noise.spread[which], rows.noise.gate[which])


def _mean_violation(kernel: Kernel, x: _PerRow, noise: Noise) -> tuple[_PerRow, _PerRow]:
    """Return the mean of max(-x - c w, 0) where noise makes contact, and minus its slope, the probability of a force."""
    # Above the gate the acceleration ends the force before the distance does, and the mean is the softened ramp. Below the gate
    # the distance alone decides: the probability keeps its value at the gate, and the mean continues along its tangent.
    held = jnp.where(x > noise.gate, x, noise.gate)
    near = held / noise.spread
    probability = kernel.share(near)
    return noise.spread * kernel.ramp(near) + probability * (held - x), probability
