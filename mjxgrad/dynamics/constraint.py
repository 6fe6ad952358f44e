r"""Laws of the constraint rows: cost, force and curvature as functions of x = J a - a_ref.

Rows come in MuJoCo's order: equality (½Dx²), friction loss (Huber, slope bounded by the loss), then limits and contacts
(½D min(x, 0)²), where an elliptic contact couples its rows in three zones. With u = (μx₀, f₁x₁, ...), N = u₀, T = |u₁..|:

- top, N ≥ μT: no cost;
- bottom, μN + T ≤ 0: ½ Σ D x²;
- middle: ½ D₀ (N - μT)² / (μ²(1 + μ²)), whose curvature in u is the sum of two positive parts,
  (1, -μτ)(1, -μτ)ᵀ and μ(μT - N)/T (I - ττᵀ), τ the unit tangent. The middle zone meets T = 0 only at the apex, and
  (μT - N)/T is at most μ + 1/μ there, so nothing needs clamping and the curvature is never indefinite.

All functions take leading batch axes, since the line search evaluates many points of a line at once.

References:
    Todorov. Convex and analytically-invertible dynamics with contacts and constraints: Theory and implementation in
    MuJoCo. ICRA 2014. MuJoCo documentation, "Computation", "Constraint model".
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


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

    reference: Float[Array, " rows"]
    weight: Float[Array, " rows"]
    bound: Float[Array, " rows"]
    scales: tuple[Float[Array, "contacts dim"], ...]


class _Cone(eqx.Module):
    """An elliptic group seen in the coordinates u, with its zones."""

    u: Float[Array, "*batch contacts dim"]
    tangent: Float[Array, "*batch contacts tangents"]
    normal: Float[Array, "*batch contacts"]
    slip: Float[Array, "*batch contacts"]
    gap: Float[Array, "*batch contacts"]
    stiffness: Float[Array, " contacts"]
    is_middle: Array
    is_bottom: Array


def _cone(
    group: ConeGroup, rows: Rows, scale: Float[Array, "contacts dim"], x: Float[Array, "*batch rows"]
) -> _Cone:
    block = x[..., group.start : group.stop].reshape(*x.shape[:-1], group.count, group.dim)
    u = block * scale
    square = jnp.sum(u[..., 1:] ** 2, axis=-1)
    slides = square > 0
    slip = jnp.where(slides, jnp.sqrt(jnp.where(slides, square, 1.0)), 0.0)
    normal, mu = u[..., 0], scale[:, 0]
    is_top = normal >= mu * slip
    is_bottom = ~is_top & (mu * normal + slip <= 0)
    stiffness = rows.weight[group.start : group.stop : group.dim] / (mu**2 * (1 + mu**2))
    tangent = u[..., 1:] / jnp.where(slides, slip, 1.0)[..., None]
    return _Cone(
        u, tangent, normal, slip, normal - mu * slip, stiffness, ~is_top & ~is_bottom, is_bottom
    )


def force(
    layout: RowLayout, rows: Rows, x: Float[Array, "*batch rows"]
) -> Float[Array, "*batch rows"]:
    """Return the constraint forces, minus the derivative of the cost with respect to x (N or N m)."""
    stop, friction = layout.simple_stop, layout.friction
    linear = -rows.weight * x
    bound = rows.bound[friction]
    limit = jnp.sign(x[..., friction]) * bound
    parts = [
        linear[..., : friction.start],
        # `where`, not `clip` and `maximum`: at a tie their derivative is one half, which belongs to neither side.
        jnp.where(jnp.abs(linear[..., friction]) < bound, linear[..., friction], -limit),
        jnp.where(x[..., friction.stop : stop] < 0, linear[..., friction.stop : stop], 0.0),
    ]
    for group, scale in zip(layout.cones, rows.scales, strict=True):
        cone = _cone(group, rows, scale, x)
        press = jnp.where(cone.is_middle, -cone.stiffness * cone.gap, 0.0)
        slide = -press[..., None] * scale[:, :1] * cone.tangent
        middle = scale * jnp.concatenate([press[..., None], slide], axis=-1)
        bottom = linear[..., group.start : group.stop].reshape(middle.shape)
        both = jnp.where(cone.is_bottom[..., None], bottom, middle)
        parts.append(both.reshape(*x.shape[:-1], group.count * group.dim))
    return jnp.concatenate(parts, axis=-1)


def curvature_product(
    layout: RowLayout,
    rows: Rows,
    x: Float[Array, " rows"],
    matrix: Float[Array, "rows columns"],
) -> Float[Array, "rows columns"]:
    """Return the second derivative of the cost with respect to x, times a matrix."""
    stop, friction = layout.simple_stop, layout.friction
    weight = rows.weight[:stop]
    stuck = jnp.abs(weight[friction] * x[friction]) < rows.bound[friction]
    is_curved = jnp.concatenate(
        [
            jnp.ones(friction.start, bool),
            stuck,
            x[friction.stop : stop] < 0,
        ]
    )
    parts = [jnp.where(is_curved, weight, 0.0)[:, None] * matrix[:stop]]
    for group, scale in zip(layout.cones, rows.scales, strict=True):
        cone = _cone(group, rows, scale, x)
        block = matrix[group.start : group.stop].reshape(group.count, group.dim, -1)
        scaled = scale[:, :, None] * block
        mu = scale[:, 0]
        along = jnp.concatenate([jnp.ones((group.count, 1), x.dtype), -mu[:, None] * cone.tangent], 1)
        ratio = jnp.where(cone.is_middle, -cone.gap / jnp.where(cone.slip > 0, cone.slip, 1.0), 0.0)
        first = along[:, :, None] * jnp.sum(along[:, :, None] * scaled, axis=1, keepdims=True)
        slide = jnp.sum(cone.tangent[:, :, None] * scaled[:, 1:], axis=1, keepdims=True)
        across = scaled[:, 1:] - cone.tangent[:, :, None] * slide
        second = jnp.concatenate(
            [jnp.zeros_like(scaled[:, :1]), (mu * ratio)[:, None, None] * across], axis=1
        )
        middle = (cone.stiffness[:, None] * scale)[:, :, None] * (first + second)
        bottom = rows.weight[group.start : group.stop].reshape(group.count, group.dim, 1) * block
        zone = jnp.where(cone.is_middle[:, None, None], middle, 0.0)
        both = jnp.where(cone.is_bottom[:, None, None], bottom, zone)
        parts.append(both.reshape(group.count * group.dim, -1))
    return jnp.concatenate(parts, axis=0)


def breakpoints(
    layout: RowLayout, rows: Rows, x: Float[Array, " rows"], slope: Float[Array, " rows"]
) -> Float[Array, " points"]:
    """Return where on the line x + t slope a row may change its law; 1 where it never does.

    Between two neighbours the derivative of the cost along the line is linear (no elliptic rows) or smooth.
    """
    stop, friction = layout.simple_stop, layout.friction
    edge = rows.bound[friction] / rows.weight[friction]
    crossings = [
        _ratio(-x[friction.stop : stop], slope[friction.stop : stop]),
        _ratio(edge - x[friction], slope[friction]),
        _ratio(-edge - x[friction], slope[friction]),
    ]
    for group, scale in zip(layout.cones, rows.scales, strict=True):
        u = x[group.start : group.stop].reshape(group.count, group.dim) * scale
        v = slope[group.start : group.stop].reshape(group.count, group.dim) * scale
        square = [jnp.sum(a[:, 1:] * b[:, 1:], axis=1) for a, b in ((u, u), (u, v), (v, v))]
        normal = [a[:, 0] * b[:, 0] for a, b in ((u, u), (u, v), (v, v))]
        mu2 = scale[:, 0] ** 2
        for cone in (
            [n - mu2 * t for n, t in zip(normal, square, strict=True)],  # N = μT
            [mu2 * n - t for n, t in zip(normal, square, strict=True)],  # μN = -T
        ):
            crossings.extend(_roots(*cone))
    return jnp.concatenate(crossings)


def _ratio(numerator: Float[Array, " n"], denominator: Float[Array, " n"]) -> Float[Array, " n"]:
    moves = denominator != 0
    t = numerator / jnp.where(moves, denominator, 1.0)
    return jnp.where(moves & jnp.isfinite(t), t, 1.0)


def _roots(
    c: Float[Array, " n"], b: Float[Array, " n"], a: Float[Array, " n"]
) -> list[Float[Array, " n"]]:
    """Return the real roots of a t² + 2 b t + c, in the form without cancellation."""
    discriminant = b * b - a * c
    real = discriminant >= 0
    q = -(b + jnp.where(b < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(real, discriminant, 0.0)))
    return [jnp.where(real, _ratio(q, a), 1.0), jnp.where(real, _ratio(c, q), 1.0)]
