r"""Contact that begins within the step, so that the simulated motion has no jumps.

MuJoCo decides once per step whether a contact or limit acts. The outcome is therefore a sawtooth in the state, with a jump where
a step enters or leaves contact, and its derivative is the slope of a tooth. An event-driven simulator would start the contact at
the time of impact. Here the step keeps its length, and takes the mean acceleration over it:

    a = ∫₀¹ a(contacts with φ > s) ds,        φ = clip(1/2 - r / w, 0, 1),        w = h |v|.

φ is the share of the step after the time of impact, with r the distance less the margin, v its rate and h the time step; a(·) is
MuJoCo's acceleration with exactly these contacts, all at the present state. A contact that begins alone gives (1 - φ) a₋ + φ a₊,
linear in φ in all directions, friction included. (The same share on the impedance would not be: rows resist with the inertia
behind them, which differs between normal and tangent.)

**Consequences.** The whole step is a continuous function of state and parameters, for contacts, joint and tendon limits, all
cones, at onset and at release. So the mean of the plain derivative over any interval is the difference of the outcome. The ramp
is centred at r = 0, where MuJoCo switches, so over the phase of a step the mean motion is MuJoCo's. φ = 1 is MuJoCo's
contact, that of bodies that rest, slide or stick deeper than w / 2; φ = 0 is none.

**Several at once.** The integral needs one solve for each of its pieces. Two are taken for any number of partial contacts,

    a = (1 - Φ) a(p₋) + Φ a(p₊),        p₋ = max(0, (φ - Φ)/(1 - Φ)),        p₊ = min(1, φ/Φ),

with Φ the mean of the partial φ, weighted by φ(1 - φ), so that a contact drops out as it begins or completes. If one contact is
partial, or all have the same φ, this is the integral. Otherwise a contact with 0 < p < 1 acts with the impedance p d.

**Slow contacts.** The derivative by r is 1 / w, so where contacts graze or chatter w has a floor, w ≥ √(h²u² + w₀²):

- Grazing: u = max(g h, g / 2(B + √K)). Below u free motion, or the weight on the contact, moves the bodies faster than they
  approach. The edges n ± μ t of a sliding pyramid act with B μ |v_t| on touch, so u grows by three times the speed that this
  force gains in a step, unless the approach is much faster than 2 g h: an impact.
- Motors: a light foot pressed down with many times its weight is stopped and released within a few steps. So u gets such a term
  for three times |J a| - g, with a the unconstrained acceleration. It adds at most 10 of the impedance's widths to w.
- Chatter: w₀ is `Onset.width` times the impedance's width, 0.1 mm by default. Each switch of a contact that chatters multiplies
  the tangent by about h Δa / w, which w₀ bounds. Impacts, much faster than 6 √(g w₀), 19 cm/s by default, are not widened by it.

Where w has its floor, r is taken ahead, r + h v (1 - h²v²/w²), which damps oscillations on the ramp.

**Change of sides.** The normal flips where two centres pass each other along it (a ball driven through a thin wall). It turns by
a right angle where another face of a box becomes the nearest to a ball's centre within the box. The present side then acts for ψ
= min(1, 1/2 + δ / w) of the step, the other side for the rest. Here δ is how much nearer the present side is, and w is how much δ
changes in a step. This covers geoms with a centre of symmetry, and balls in boxes.

**Limits.** True discontinuities remain: hit or miss, an edge that catches, boxes that change their touching faces, three faces of
a box equally near. A contact shorter than about three steps is smooth but not resolved. The distance of boxes and meshes is known
only where they overlap, except from planes, and between boxes and balls. Without a distance the ramp lies at 0 > r > -w:
continuous, but half a step late.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022, arXiv:2202.00817.
    Zhong, Han, Brikis. Differentiable physics simulations with contacts: do they have correct gradients w.r.t. position, velocity
    and control? arXiv:2207.05060 (time of impact). Kong, Payne, Zhu, Johnson. Saltation matrices. arXiv:2306.06862.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import Legible, as_float, is_known
from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import safe_norm, safe_sqrt
from mjxgrad.bodies.kinematics import com_vel
from mjxgrad.contact.collision import WITHOUT_CENTRE, are, is_blind, other_sides, slot_geoms
from mjxgrad.contact.law import Impedance, stiffness_damping
from mjxgrad.solver.jacobian import RowMap
from mjxgrad.solver.newton import Variant
from mjxgrad.stepping.rows import Block, joined, law, row_map, weight_of

_Vector = Float[Array, " nv"]
_PerRow = Float[Array, " rows"]
_PerContact = Float[Array, " contacts"]
_Split = tuple[tuple[_PerRow, _PerRow], Float[Array, ""], Bool[Array, ""], tuple[RowMap | None, ...] | None]
# Least share of its impedance with which a partial contact acts: a weight of zero has no finite derivative.
_LEAST_SHARE = 1e-9
# Factor on a pyramid's slip in the width. Derivatives of a box pushed along the floor at 4 ms are 10⁷ with 1, 1 to 4 with 2 or 3.
_SLIP = 3.0
# Factor on the acceleration by motors in the width, and its bound in widths of the impedance: feet of robots chatter with less.
_PRESS, _WIDEST = 3.0, 10.0
_ENDLESS, _USUAL_WIDTH = 1e3, 1e-3  # width of an impedance (m) beyond any contact, and the width used in its place
# Ratio to the slow speed beyond which a contact is an impact; fourth powers beyond it are too large for single precision.
_IMPACT = 1e3
_GRAVITY = 9.81  # gravity (m/s²) that separates impacts from chatter in scenes without gravity


class Onset(Legible):
    """Contacts and limits that begin within the step; see `mjxgrad.stepping.onset`.

    A pytree: a sweep over the width is one `jax.vmap`, and the step can be differentiated by it.

    Attributes:
        width: least width of the ramp over which a contact begins, as a share of its impedance's width (`solimp[2]`; 0.1 of
            MuJoCo's default is 0.1 mm). It bounds the derivative where contacts chatter; 0 sets no bound.
    """

    width: Float[Array, "..."] = eqx.field(converter=functools.partial(as_float, name="width"), default=0.1)

    def __check_init__(self):
        if is_known(self.width) and not np.all((np.asarray(self.width) >= 0) & np.isfinite(self.width)):
            given = np.asarray(self.width)
            raise ValueError(f"width must be finite and not negative, got {given!s}: 0.1 is the default, 0 no floor")


def reach(model: mjx.Model, data: mjx.Data, onset: Onset) -> Float[Array, ""]:
    """Return the distance less the margin beyond which no contact acts in the coming step (m)."""
    # It assumes that no contact is stiffer or slower than those of the data, and that geoms lie within their bounding spheres.
    contact, h = data._impl.contact, model.opt.timestep
    speed = _largest_rate(model, data, data.cvel)
    free = _largest_rate(model, data, com_vel(model, data.replace(qvel=data.qacc_smooth)).cvel)
    stiffness, damping = stiffness_damping(model, contact.solref, contact.solimp[:, 1])
    gravity = safe_sqrt(jnp.sum(model.opt.gravity**2))
    depth = _depth(contact.solimp)
    creep = _creep(gravity, _PRESS * free, h, stiffness, damping, depth) + _SLIP * h * damping * speed
    least = safe_sqrt((h * creep) ** 2 + (onset.width * depth) ** 2)
    return jnp.max(h * speed + 0.5 * jnp.maximum(h * speed, least))


def _largest_rate(model: mjx.Model, data: mjx.Data, motion: Float[Array, "nbody 6"]) -> Float[Array, ""]:
    """Return an upper bound on the approach speed of any two geoms, from body motions about `subtree_com`."""
    turning, moving = motion[model.geom_bodyid, :3], motion[model.geom_bodyid, 3:]
    lever = data.geom_xpos - data.subtree_com[model.body_rootid[model.geom_bodyid]]
    rates = safe_norm(moving + jnp.cross(turning, lever)) + safe_norm(turning) * model.geom_rbound
    return jnp.sum(jnp.sort(rates)[-2:])


def _depth(solimp: Float[Array, "contacts 5"]) -> _PerContact:
    """Return the width of the impedance, or MuJoCo's default where a width of zero or beyond any contact makes it constant."""
    width = solimp[:, 2]
    return jnp.where((width > 0) & (width < _ENDLESS), width, _USUAL_WIDTH)


def _creep(
    gravity: Array, press: Array, h: Array, stiffness: _PerContact, damping: _PerContact, depth: _PerContact
) -> _PerContact:
    """Return the speed u below which gravity and pressing forces move bodies faster than they approach."""
    resistance = damping + safe_sqrt(stiffness)
    time = jnp.maximum(h, 1 / jnp.where(resistance > 0, 2 * resistance, jnp.inf))
    more, most = press * time, _WIDEST * depth / h
    both = safe_sqrt(more**2 + most**2)
    return gravity * time + more * (most / jnp.where(both > 0, both, 1.0))


class TwoSolves(eqx.Module):
    """The two solves of a step with partial contacts: first with p₊, whose weight is Φ (`share`), then with p₋.

    `is_split` says whether p₋ and p₊ differ.
    """

    variants: Variant
    share: Float[Array, ""]
    is_split: Bool[Array, ""]


def begin(model: mjx.Model, data: mjx.Data, blocks: list[Block], onset: Onset) -> tuple[list[Block], TwoSolves | None]:
    """Return rows that are active if they act for any part of the step, and its two solves; None if no row begins or ends."""
    if not any(block.rows_each for block in blocks):
        return blocks, None
    found, sides, rows = [], [], []
    for block in blocks:
        if not block.rows_each:
            rows.append(block)
            found.append(jnp.ones_like(block.residual))
            sides.append(None)
            continue
        share, side = _share(model, data, block, onset)
        share = jnp.repeat(share, block.rows_each)
        present = jnp.where(block.residual > 0, block.impedance.onset, block.impedance.present)
        impedance = Impedance(present, block.impedance.full, block.impedance.onset)
        rows.append(dataclasses.replace(block, is_active=share > 0, impedance=impedance))
        found.append(share)
        sides.append(side)
    return rows, _two_solves(model, data, rows, _split(blocks, found, sides))


def _two_solves(model: mjx.Model, data: mjx.Data, blocks: list[Block], split: _Split) -> TwoSolves:
    rows, (both, share, is_split, turned_parts) = joined(blocks), split

    def weigh(share: _PerRow) -> _PerRow:
        least = jnp.where(share > _LEAST_SHARE, share, _LEAST_SHARE)
        return jnp.where(share > 0, weight_of(rows, least * rows.impedance.present), 0.0)

    weight = jax.vmap(weigh)(jnp.stack(both))
    if turned_parts is None:
        return TwoSolves(Variant(weight), share, is_split)
    turned = dataclasses.replace(rows, map=rows.map.with_parts(turned_parts))  # pyright: ignore[reportAttributeAccessIssue]
    references = [law(model, data.qvel, block)[0] for block in (rows, turned)]
    parts = tuple(
        None if other is None else jax.tree.map(lambda *x: jnp.stack(x), block.map, other)
        for block, other in zip(blocks, turned_parts, strict=True)
    )
    return TwoSolves(Variant(weight, jnp.stack(references), parts), share, is_split)


class _Side(eqx.Module):
    """The other side of a block's contacts: ψ, the share of the present side, and the rows of the other side."""

    share: _PerContact
    map: RowMap


def _share(model: mjx.Model, data: mjx.Data, block: Block, onset: Onset) -> tuple[_PerContact, _Side | None]:
    """Return φ of each contact or limit of a block, and its other side; None where no sides can change."""
    rates = block.map.mv(data.qvel).reshape(-1, block.rows_each)
    rate, distance = _normal(block, rates), block.residual[:: block.rows_each]
    travel = model.opt.timestep * jnp.abs(rate)
    least = _least_width(model, data, block, onset, rates)
    width = jnp.where(travel > least, travel, least)
    slow = 1 - (travel / jnp.where(width > 0, width, 1.0)) ** 2
    distance = distance + model.opt.timestep * rate * slow
    if block.slots is None:
        return _ramp(distance, width, 0.5), None
    slots = slot_geoms(model, data)
    geoms = (data._impl.contact.geom if slots is None else slots)[slice(*block.slots)]
    share = _ramp(distance, width, jnp.where(is_blind(model, geoms), 0.0, 0.5))
    return share, _side(model, data, block, geoms, rate, least)


def _least_width(
    model: mjx.Model, data: mjx.Data, block: Block, onset: Onset, rates: Float[Array, "contacts each"]
) -> _PerContact:
    """Return the floor √(h²u² + w₀²) of an onset's ramp, for contacts that graze or chatter."""
    each, h, rate = block.rows_each, model.opt.timestep, _normal(block, rates)
    stiffness, damping = (x[::each] for x in stiffness_damping(model, block.solref, block.impedance.full))
    gravity = safe_sqrt(jnp.sum(model.opt.gravity**2))
    press = jnp.abs(_normal(block, block.map.mv(data.qacc_smooth).reshape(-1, each))) - gravity
    press = _PRESS * jnp.where(press > 0, press, 0.0)
    depth = _depth(block.solimp[::each])
    creep = _creep(gravity, press, h, stiffness, damping, depth)
    if block.is_pyramid:
        slip = jnp.max(jnp.abs(rates - rate[:, None]), axis=1)
        creep = creep + _SLIP * h * damping * slip * _is_slow(rate, 2 * h * gravity)
    floor = onset.width.astype(rate.dtype) * depth
    # Six times the speed of a fall over such a length: with three, derivatives of a pushed ball scatter twice as much.
    chatters = _is_slow(rate, 6 * safe_sqrt(jnp.where(gravity > 0, gravity, _GRAVITY) * floor))
    return safe_sqrt((h * creep) ** 2 + chatters * floor**2)


def _normal(block: Block, rates: Float[Array, "contacts each"]) -> _PerContact:
    return jnp.mean(rates, axis=1) if block.is_pyramid else rates[:, 0]


def _is_slow(rate: _PerContact, speed: Float[Array, "..."]) -> _PerContact:
    """Return 1 for rates much slower than a speed, falling to 0 for impacts."""
    # The ratio first: the derivative squares the fourth power, and at 1e-6 m/s that would underflow in single precision.
    is_impact = jnp.abs(rate) >= _IMPACT * speed
    ratio = jnp.where(is_impact, 0.0, rate) / jnp.where(is_impact, 1.0, speed)
    return jnp.where(is_impact, 0.0, 1 / (1 + ratio**4))


def _ramp(distance: _PerContact, width: _PerContact, centre: Float[Array, "..."] | float) -> _PerContact:
    # `where`, not `clip`, whose derivative at a tie is one half. Without a width the ramp is MuJoCo's step.
    has_width = width > 0
    share = centre - distance / jnp.where(has_width, width, 1.0)
    share = jnp.where(share > 0, jnp.where(share < 1, share, 1.0), 0.0)
    return jnp.where(has_width, share, (distance < 0).astype(distance.dtype))


def _side(
    model: mjx.Model, data: mjx.Data, block: Block, geoms: Array | np.ndarray, rate: _PerContact, least: _PerContact
) -> _Side | None:
    """Return the share ψ of each contact's present side, and the rows of its other side; None if no contact has one."""
    can_turn = ~are(model, geoms, WITHOUT_CENTRE).any(axis=1)
    if isinstance(can_turn, np.ndarray) and not can_turn.any():
        return None
    assert block.slots is not None
    own = slice(*block.slots)
    contact = jax.tree.map(lambda x: x[own], data._impl.contact)
    others, nearer = other_sides(model, data, contact, geoms)
    dim = block.rows_each // 2 + 1 if block.is_pyramid else block.rows_each
    turned = row_map(model, data, others, own.start, dim)
    turning = model.opt.timestep * jnp.abs(rate - _normal(block, turned.mv(data.qvel).reshape(-1, block.rows_each)))
    width = jnp.where(turning > 2 * least, turning, 2 * least)
    share = 0.5 + nearer / jnp.where(width > 0, width, 1.0)
    return _Side(jnp.where(can_turn & (width > 0) & (share < 1), jnp.where(share > 0.5, share, 0.5), 1.0), turned)


def _split(blocks: list[Block], shares: list[Float[Array, " _"]], sides: list[_Side | None]) -> _Split:
    """Return p₊ and p₋, Φ, whether p₋ and p₊ differ, and J of the solve with p₋ by block, from φ of the rows."""
    # J is None where it is that of the other solve; it differs where contacts act from another side.
    # The first row of a contact or limit represents it in the mean.
    numbered = [(np.arange(len(block.residual)), block.rows_each) for block in blocks]
    is_first = np.concatenate([row % num == 0 if num else np.zeros(len(row), bool) for row, num in numbered])
    whole, present = jnp.concatenate(shares), 1.0
    if any(side is not None for side in sides):
        each = zip(blocks, shares, sides, strict=True)
        own = [jnp.ones_like(x) if side is None else jnp.repeat(side.share, block.rows_each) for block, x, side in each]
        present = jnp.concatenate(own)
    share = whole * present
    is_partial = (share > 0) & (share < 1)
    counts = jnp.where(is_partial & is_first, share * (1 - share), 0.0)
    total = jnp.sum(counts)
    is_split = total > 0
    # Without partial contacts only the solve with p₊ counts.
    weight = jnp.where(is_split, jnp.sum(counts * share) / jnp.where(is_split, total, 1.0), 1.0)
    rest = jnp.where(is_split & (weight < 1), 1 - weight, 1.0)
    early, late = share - weight, share / weight
    before = jnp.where(early > 0, early / rest, 0.0)
    before = jnp.where((share == 1) | ~is_split, share, before)
    after = jnp.where(late < 1, late, 1.0)
    if isinstance(present, float):
        return (after, before), weight, is_split, None
    # The other side acts for the rest of φ. Each solve keeps the side with the larger share, less the smaller share.
    turns = (present < 1) & is_split
    before, after = (jnp.where(turns, p - (1 - p) * whole, p) for p in (before, after))
    parts, start = [], 0
    for block, side in zip(blocks, sides, strict=True):
        rows = slice(start, start + len(block.residual))
        parts.append(None if side is None else _chosen(before[rows] < 0, side.map, block.map))
        start = rows.stop
    return (jnp.where(after > 0, after, 0.0), jnp.abs(before)), weight, is_split, tuple(parts)


def _chosen(is_other: Bool[Array, " rows"], other: RowMap, own: RowMap) -> RowMap:
    """Return a map with the rows of `other` where chosen, and those of `own` elsewhere."""

    def choose(a: Array, b: Array) -> Array:
        if a is b:  # shared by both, not by row
            return b
        return jnp.where(is_other[:: len(is_other) // len(a)].reshape(-1, *(1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, other, own)
