r"""Laws of the constraint rows: cost, force and curvature as functions of x = J a - a_ref.

Rows come in MuJoCo's order: equality (½Dx²), friction loss (Huber, slope bounded by the loss), then limits and contacts
(½D min(x, 0)²), where an elliptic contact couples its rows in three zones. With u = (μx₀, f₁x₁, ...), N = u₀, T = |u₁..|:

- top, N ≥ μT: no cost;
- bottom, μN + T ≤ 0: ½ Σ D x²;
- middle: ½ D₀ (N - μT)² / (μ²(1 + μ²)), whose curvature in u is the sum of two positive parts,
  (1, -μτ)(1, -μτ)ᵀ and μ(μT - N)/T (I - ττᵀ), τ the unit tangent. The middle zone meets T = 0 only at the apex, and
  (μT - N)/T is at most μ + 1/μ there, so nothing needs clamping and the curvature is never indefinite.

Arrays may carry the batch as trailing axes, see `linear`.

References:
    Todorov. Convex and analytically-invertible dynamics with contacts and constraints: Theory and implementation in
    MuJoCo. ICRA 2014. MuJoCo documentation, "Computation", "Constraint model".
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjxgrad.dynamics.linear import sum_of_few


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
    """Which law holds on which rows. Static: it shapes the compiled program."""

    num_equality: int
    num_friction: int
    num_rows: int
    cones: tuple[ConeGroup, ...] = ()

    @property
    def friction(self) -> slice:
        return slice(self.num_equality, self.num_equality + self.num_friction)

    @property
    def simple_stop(self) -> int:
        """End of the rows that stand for themselves."""
        return self.cones[0].start if self.cones else self.num_rows


class Rows(eqx.Module):
    """Parameters of the constraint rows of one state.

    Attributes:
        reference: a_ref, the acceleration that a row asks for (m/s² or rad/s²).
        weight: D, the inverse of the regularisation R (kg or kg m²).
        bound: largest force of a friction loss row (N or N m); elsewhere unused.
        scales: per elliptic group (μ, f₁, ..., f_dim-1) of each contact; μ = f₁/√impratio.
    """

    reference: Float[Array, "rows *batch"]
    weight: Float[Array, "rows *batch"]
    bound: Float[Array, "rows *batch"]
    scales: tuple[Float[Array, "_ _ *batch"], ...]


class _Cone(eqx.Module):
    """An elliptic group seen in the coordinates u, with its zones."""

    tangent: Float[Array, "contacts tangents *batch"]
    slip: Float[Array, "contacts *batch"]
    gap: Float[Array, "contacts *batch"]
    stiffness: Float[Array, "contacts *batch"]
    is_middle: Bool[Array, "contacts *batch"]
    is_bottom: Bool[Array, "contacts *batch"]


def _cone(
    group: ConeGroup, rows: Rows, scale: Float[Array, "contacts dim *batch"], x: Float[Array, "rows *batch"]
) -> _Cone:
    u = _blocks(group, x) * scale
    square = sum_of_few(u[:, 1:] ** 2)[:, 0]
    slides = square > 0
    slip = jnp.where(slides, jnp.sqrt(jnp.where(slides, square, 1.0)), 0.0)
    mu = scale[:, 0]
    normal = u[:, 0]
    is_top = normal >= mu * slip
    is_bottom = ~is_top & (mu * normal + slip <= 0)
    weight = rows.weight[group.start : group.stop : group.dim]
    tangent = u[:, 1:] / jnp.where(slides, slip, 1.0)[:, None]
    stiffness = weight / (mu**2 * (1 + mu**2))
    return _Cone(tangent, slip, normal - mu * slip, stiffness, ~is_top & ~is_bottom, is_bottom)


def _blocks(group: ConeGroup, x: Float[Array, "rows *rest"]) -> Float[Array, "contacts dim *rest"]:
    return x[group.start : group.stop].reshape(group.count, group.dim, *x.shape[1:])


def force(layout: RowLayout, rows: Rows, x: Float[Array, "rows *batch"]) -> Float[Array, "rows *batch"]:
    """Return the constraint forces, minus the derivative of the cost with respect to x (N or N m)."""
    stop, friction = layout.simple_stop, layout.friction
    linear = -rows.weight * x
    bound = rows.bound[friction]
    limit = jnp.sign(x[friction]) * bound
    # `where`, not `clip` and `maximum`: at a tie their derivative is one half, which belongs to neither side.
    parts = [
        linear[: friction.start],
        jnp.where(jnp.abs(linear[friction]) < bound, linear[friction], -limit),
        jnp.where(x[friction.stop : stop] < 0, linear[friction.stop : stop], 0.0),
    ]
    for group, scale in zip(layout.cones, rows.scales, strict=True):
        cone = _cone(group, rows, scale, x)
        press = jnp.where(cone.is_middle, -cone.stiffness * cone.gap, 0.0)
        slide = -(press * scale[:, 0])[:, None] * cone.tangent
        middle = scale * jnp.concatenate([press[:, None], slide], axis=1)
        both = jnp.where(cone.is_bottom[:, None], _blocks(group, linear), middle)
        parts.append(both.reshape(-1, *x.shape[1:]))
    return jnp.concatenate([part for part in parts if part.shape[0]])


def curvature_product(
    layout: RowLayout,
    rows: Rows,
    x: Float[Array, "rows *batch"],
    matrix: Float[Array, "rows columns *batch"],
) -> Float[Array, "rows columns *batch"]:
    """Return the second derivative of the cost with respect to x, times a matrix."""
    stop, friction = layout.simple_stop, layout.friction
    weight = rows.weight[:stop]
    stuck = jnp.abs(weight[friction] * x[friction]) < rows.bound[friction]
    equality = jnp.ones_like(x[: friction.start], bool)
    is_curved = jnp.concatenate([equality, stuck, x[friction.stop : stop] < 0])
    parts = [jnp.where(is_curved, weight, 0.0)[:, None] * matrix[:stop]]
    for group, scale in zip(layout.cones, rows.scales, strict=True):
        cone = _cone(group, rows, scale, x)
        block = _blocks(group, matrix)
        scaled = scale[:, :, None] * block
        mu = scale[:, 0]
        along = jnp.concatenate([jnp.ones_like(mu)[:, None], -mu[:, None] * cone.tangent], axis=1)
        ratio = jnp.where(cone.is_middle, -cone.gap / jnp.where(cone.slip > 0, cone.slip, 1.0), 0.0)
        first = along[:, :, None] * sum_of_few(along[:, :, None] * scaled)
        slide = sum_of_few(cone.tangent[:, :, None] * scaled[:, 1:])
        across = scaled[:, 1:] - cone.tangent[:, :, None] * slide
        second = jnp.concatenate([jnp.zeros_like(scaled[:, :1]), (mu * ratio)[:, None, None] * across], axis=1)
        middle = (cone.stiffness[:, None] * scale)[:, :, None] * (first + second)
        bottom = _blocks(group, rows.weight)[:, :, None] * block
        zone = jnp.where(cone.is_middle[:, None, None], middle, 0.0)
        both = jnp.where(cone.is_bottom[:, None, None], bottom, zone)
        parts.append(both.reshape(-1, *matrix.shape[1:]))
    return jnp.concatenate(parts, axis=0)
