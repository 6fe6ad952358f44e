r"""Contact that begins within the step, so that the simulated motion has no jumps.

MuJoCo decides once per step whether a contact or limit acts. The simulated outcome is therefore a sawtooth in the state: smooth
while the same steps are in contact, with a jump wherever a step joins or leaves them, and its derivative is that of a tooth.
An event-driven simulator would find the time of impact and start the contact there; its motion has no teeth, and its derivative
has the saltation term. Here the step keeps its length, and takes the mean of the acceleration over it:

    a = ∫₀¹ a(contacts with φ > s) ds,        φ = clip(1/2 - r / w, 0, 1),        w = h |v|.

φ is the share of the step that follows the time of impact, with r the distance less the margin, v its rate and h the time
step; a(·) is MuJoCo's own acceleration with these contacts and no others, all taken at the present state. A contact that
begins alone acts with (1 - φ) a₋ + φ a₊, so its impulse is linear in φ in all directions, friction included, and whatever else
the bodies touch. (The same share put on the impedance is not: rows resist by the inertia behind them, which is another along the
normal than across it. On gymnasium's ant at 10 ms that shifts the mean by 6 mm, ten times the error of MuJoCo's step.)

**Consequences.** The solve is strictly convex and its weights are continuous in φ, so the whole step is a continuous function of
state and parameters, for contacts, joint and tendon limits, all cones, at the beginning and at release. Hence:

1. The plain derivative is unbiased by the fundamental theorem of calculus: its mean over any interval is the difference of the
   outcome. No saltation term is needed, and no assumption on order, speed or duration of contacts.
2. The ramp is centred at r = 0, where MuJoCo switches, so over the phase of a step the mean motion is MuJoCo's: what is lost is
   the sawtooth, which is error of the time step. φ = 1 is MuJoCo's contact, φ = 0 is none, and bodies that rest,
   slide or stick deeper than w / 2 have φ = 1.

**Several at once.** The integral needs a solve for each of its pieces. Two are taken, however many contacts are partial,

    a = (1 - Φ) a(p₋) + Φ a(p₊),        p₋ = max(0, (φ - Φ)/(1 - Φ)),        p₊ = min(1, φ/Φ),

Φ the mean of the partial φ with weights φ(1 - φ), so that a contact drops out of it as it begins or completes. Where one
contact is partial, or all are alike, p is 0 or 1 and this is the integral; else a contact with 0 < p < 1 acts with the
impedance p d. It is continuous throughout, and the mean share is φ.

**Slow contacts.** The derivative by r is 1 / w, so where contacts graze or chatter w has a floor, w ≥ √(h²u² + w₀²):

- u = max(g h, g / 2(B + √K)) holds for grazing: below it free motion, or the weight on the contact, moves the bodies faster than
  they approach. The edges n ± μ t of a pyramid that slides push with B μ |v_t| as soon as they touch, often many times the
  weight; the body then rides on the ramp itself, and u grows by three times what this push gains in a step, unless the
  approach is much faster than 2 g h: an impact.
- Motors press a light foot down with many times its weight. It is stopped and let go within a few steps, again and again, and
  each time its tangent grows by some h Δa / u. So u has as much on top for three times |J a| - g, with a the acceleration that
  there would be without contact; smoothly bounded, so that it adds no more than 10 of the impedance's widths to w. What only
  falls or rolls has none of it.
- w₀ is `Onset.width` times the impedance's width, 0.1 mm by default. Where contacts chatter (a thing pushed along the floor) each
  switch multiplies the tangent by about h Δa / w, and w₀ bounds it at every time step. A larger one is a smoother motion,
  farther from MuJoCo's. Impacts, much faster than 6 √(g w₀), 19 cm/s by default, keep the width of their own flight.

On the floor r is taken ahead, r + h v (1 - h²v²/w²): that damps what else would swing on the ramp.

**Change of sides.** The normal flips where two centres pass each other along it (a ball driven through a thin wall), and turns
by a right angle where another face of a box comes nearest to a ball's centre within it. Both sides push then for their share of
the step: the present one for ψ = 1/2 + δ / w, at most 1, with δ by how much nearer it is, w what δ changes by in a step, and the
other one, at the same depth, for the rest. For geoms with a centre of symmetry, and balls in boxes.

**What it cannot do.** Real discontinuities remain: hit or miss, an edge that catches or not. So do jumps where two boxes change
the faces that touch, and where three faces of a box are equally near within a step. A contact of fewer than about three steps is
smooth and still not resolved. Chatter still multiplies tangents, within what the width allows. The distance of boxes and meshes
is known only where they overlap, except from planes, and of boxes from balls: there the ramp lies at 0 > r > -w, continuous and
half a step late.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022, arXiv:2202.00817.
    Zhong, Han, Brikis. Differentiable physics simulations with contacts: do they have correct gradients w.r.t. position, velocity
    and control? arXiv:2207.05060 (time of impact). Kong, Payne, Zhu, Johnson. Saltation matrices. arXiv:2306.06862.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import as_float, is_known
from mjxgrad._mjx import mjx
from mjxgrad.batched.maps import safe_norm, safe_sqrt
from mjxgrad.bodies.kinematics import com_vel
from mjxgrad.contact.collision import WITHOUT_CENTRE, are, is_blind, other_sides, slot_geoms
from mjxgrad.contact.law import Impedance, stiffness_damping
from mjxgrad.solver.jacobian import RowMap
from mjxgrad.solver.newton import Variant
from mjxgrad.stepping.rows import Block, joined, law, per_row, row_map, weight_of

_Vector = Float[Array, " nv"]
_PerRow = Float[Array, " rows"]
_PerContact = Float[Array, " contacts"]
# Impedance of a partial contact is no smaller than this part of its own: a weight of zero has no logarithm's derivative.
_LEAST_SHARE = 1e-9
# What a pyramid's slip adds to the width. Derivatives of a box pushed along the floor at 4 ms are 10⁷ with 1, 1 to 4 with 2 or 3.
_SLIP = 3.0
# What motors press together adds this part to gravity, and this many times the impedance's width at most: with less of either,
# feet of MuJoCo Playground's robots chatter; with no bound, a strong servo holds a light link off the floor.
_PRESS, _WIDEST = 3.0, 10.0
# Of the impedance's width, half the ramp's least width at MuJoCo's own motion; as for C MuJoCo's step, see `native.events`.
_AT_MOTION = 0.06
# In m, of impedances: wider than any contact, and what takes its place.
_ENDLESS, _USUAL_WIDTH = 1e3, 1e-3
# How many times faster an impact is than what counts as slow: the fourth power is beyond single precision.
_IMPACT = 1e3
# In m/s², where a scene has none: what is an impact and what chatters.
_GRAVITY = 9.81


class Onset(eqx.Module):
    """Contacts and limits that begin within the step; see `mjxgrad.stepping.onset`.

    A pytree: a sweep over the width is one `jax.vmap`, and the step can be differentiated by it.

    Attributes:
        width: least width of the ramp over which a contact begins, as a share of its impedance's width (`solimp[2]`; 0.1 of
            MuJoCo's default is 0.1 mm). It bounds the derivative where contacts chatter; 0 is none.
    """

    width: Float[Array, "..."] = eqx.field(converter=as_float, default=0.1)

    def __check_init__(self):
        """Refuse widths that are negative or not finite, if they are known."""
        if is_known(self.width) and not np.all((np.asarray(self.width) >= 0) & np.isfinite(self.width)):
            given = np.asarray(self.width)
            raise ValueError(f"width must be finite and not negative, got {given!s}: 0.1 is the default, 0 no floor")

    def check(self, gradient: str) -> None:
        """Refuse what a single step cannot take."""
        if self.width.ndim:
            raise ValueError(f"width must be one value for a step, got shape {self.width.shape}: sweep under jax.vmap")
        if gradient == "slope":
            raise ValueError(
                "gradient must be 'discrete' with an onset, got 'slope': that one is for MuJoCo's motion to the bit, "
                "onset=None; a motion without jumps has the slope as its plain derivative"
            )


def reach(model: mjx.Model, data: mjx.Data, onset: Onset) -> Float[Array, ""]:
    """Return a distance, less the margin, from which on no contact acts in the coming step (m).

    Contacts are taken to be no stiffer or slower than those of the data, and geoms to stay within their bounding spheres.
    """
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
    """Return how fast the surfaces of two geoms approach at most, from the motion of bodies about `subtree_com`."""
    turning, moving = motion[model.geom_bodyid, :3], motion[model.geom_bodyid, 3:]
    lever = data.geom_xpos - data.subtree_com[model.body_rootid[model.geom_bodyid]]
    rates = safe_norm(moving + jnp.cross(turning, lever)) + safe_norm(turning) * model.geom_rbound
    return jnp.sum(jnp.sort(rates)[-2:])


def _depth(solimp: Float[Array, "contacts 5"]) -> _PerContact:
    """Return the width of the impedance; where it is the same at every depth, by 0 or an endless one, MuJoCo's default."""
    width = solimp[:, 2]
    return jnp.where((width > 0) & (width < _ENDLESS), width, _USUAL_WIDTH)


def _creep(
    gravity: Float[Array, ""],
    press: Float[Array, "..."],
    h: Float[Array, ""],
    stiffness: _PerContact,
    damping: _PerContact,
    depth: _PerContact,
) -> _PerContact:
    """Return the speed below which free motion, or what presses on a contact, moves bodies faster than they approach."""
    resistance = damping + safe_sqrt(stiffness)
    time = jnp.maximum(h, 1 / jnp.where(resistance > 0, 2 * resistance, jnp.inf))
    more, most = press * time, _WIDEST * depth / h
    both = safe_sqrt(more**2 + most**2)
    return gravity * time + more * (most / jnp.where(both > 0, both, 1.0))


class Shares(eqx.Module):
    """For which part of the step each row acts: p₋ and p₊, 1 for rows that never begin or end, Φ, and whether these differ.

    `parts` of J, block by block, are those of the solve with p₋ where some push from another side; None where none ever does.
    """

    before: _PerRow
    after: _PerRow
    weight: Float[Array, ""]
    is_split: Bool[Array, ""]
    parts: tuple[RowMap | None, ...] | None


class Partial(eqx.Module):
    """Contacts that act for a part of the step, as two solves take them: with p₊, whose weight is Φ, and with p₋."""

    variants: Variant
    share: Float[Array, ""]
    is_split: Bool[Array, ""]


def begin(
    model: mjx.Model,
    data: mjx.Data,
    blocks: list[Block],
    onset: Onset,
    after: _Vector | None = None,
    *,
    without: tuple[bool, bool] = (False, False),
) -> tuple[list[Block], Shares | None]:
    """Return constraint rows present wherever they act for a part of the step, and for which; None if none begins or ends.

    `after`, the velocity that MuJoCo's step leaves, makes the shares those of its own motion, for a derivative there. `without`
    says whether contacts, and limits, are left as they are, averaged over noise on their distance.
    """
    if not any(block.rows_each for block in blocks):
        return blocks, None
    found, sides, rows, num_contacts = [], [], [], 0
    for block in blocks:
        if not block.rows_each or without[not block.is_contact]:
            rows.append(block)
            found.append(jnp.ones_like(block.residual))
            sides.append(None)
            continue
        each, count = block.rows_each, len(block.residual) // block.rows_each
        geoms = slice(num_contacts, num_contacts + count) if block.is_contact else None
        num_contacts += count if block.is_contact else 0
        share, side = _share(model, data, block, onset, geoms, after)
        share = per_row(share, each)
        present = jnp.where(block.residual > 0, block.impedance.onset, block.impedance.present)
        impedance = Impedance(present, block.impedance.full, block.impedance.onset)
        rows.append(dataclasses.replace(block, is_active=share > 0, impedance=impedance))
        found.append(share)
        sides.append(side)
    return rows, _split(blocks, found, sides)


def partial(model: mjx.Model, data: mjx.Data, blocks: list[Block], shares: Shares | None) -> Partial | None:
    """Return in what the solves of a step differ, from what `begin` gives, or these rows under noise."""
    if shares is None:
        return None
    rows = joined(blocks)

    def weigh(share: _PerRow) -> _PerRow:
        least = jnp.where(share > _LEAST_SHARE, share, _LEAST_SHARE)
        return jnp.where(share > 0, weight_of(rows, least * rows.impedance.present), 0.0)

    weight = jax.vmap(weigh)(jnp.stack([shares.after, shares.before]))
    if shares.parts is None:
        return Partial(Variant(weight), shares.weight, shares.is_split)
    turned = dataclasses.replace(rows, map=rows.map.with_parts(shares.parts))  # pyright: ignore[reportAttributeAccessIssue]
    references = [law(model, data.qvel, block)[0] for block in (rows, turned)]
    parts = tuple(
        None if other is None else jax.tree.map(lambda *x: jnp.stack(x), block.map, other)
        for block, other in zip(blocks, shares.parts, strict=True)
    )
    return Partial(Variant(weight, jnp.stack(references), parts), shares.weight, shares.is_split)


class _Side(eqx.Module):
    """What may push instead of the contacts of a block: ψ, for which part the present side pushes, and the other's rows."""

    share: _PerContact
    map: RowMap


def _share(
    model: mjx.Model, data: mjx.Data, block: Block, onset: Onset, contacts: slice | None, after: _Vector | None
) -> tuple[_PerContact, _Side | None]:
    """Return φ of each contact or limit of a block, and what may push instead of it; None where no sides change."""
    each, h = block.rows_each, model.opt.timestep
    rates = block.map.mv(data.qvel).reshape(-1, each)
    rate = _normal(block, rates)
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
    # Six times the speed of a fall over such a length: half of it leaves derivatives of a pushed ball twice as scattered.
    chatters = _is_slow(rate, 6 * safe_sqrt(jnp.where(gravity > 0, gravity, _GRAVITY) * floor))
    travel, least = h * jnp.abs(rate), safe_sqrt((h * creep) ** 2 + chatters * floor**2)
    width = jnp.where(travel > least, travel, least)
    slow = 1 - (travel / jnp.where(width > 0, width, 1.0)) ** 2
    distance = block.residual[::each] + h * rate * slow
    if after is not None:
        least = 2 * _AT_MOTION * depth
        ahead = h * jnp.abs(_normal(block, block.map.mv(after).reshape(-1, each)))
        width = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(travel, ahead), least))
        distance = block.residual[::each]
    if contacts is None:
        return _ramp(distance, width, 0.5), None
    slots = slot_geoms(model, data)
    geoms = (data._impl.contact.geom if slots is None else slots)[contacts]
    share = _ramp(distance, width, jnp.where(is_blind(model, geoms), 0.0, 0.5))
    return share, _side(model, data, block, contacts, geoms, rate, least)


def _normal(block: Block, rates: Float[Array, "contacts each"]) -> _PerContact:
    """Return the rates along the normal."""
    return jnp.mean(rates, axis=1) if block.is_pyramid else rates[:, 0]


def _is_slow(rate: _PerContact, speed: Float[Array, "..."]) -> _PerContact:
    """Return 1 for what is much slower than a speed, and 0 for impacts."""
    # By their ratio: the square of a fourth power, of 1e-6 m/s, is nothing in single precision.
    is_impact = jnp.abs(rate) >= _IMPACT * speed
    ratio = jnp.where(is_impact, 0.0, rate) / jnp.where(is_impact, 1.0, speed)
    return jnp.where(is_impact, 0.0, 1 / (1 + ratio**4))


def _ramp(distance: _PerContact, width: _PerContact, centre: Float[Array, "..."] | float) -> _PerContact:
    # `where`, not `clip`: at a tie its derivative is one half. Without a width there is MuJoCo's step.
    has_width = width > 0
    share = centre - distance / jnp.where(has_width, width, 1.0)
    share = jnp.where(share > 0, jnp.where(share < 1, share, 1.0), 0.0)
    return jnp.where(has_width, share, (distance < 0).astype(distance.dtype))


def _side(
    model: mjx.Model,
    data: mjx.Data,
    block: Block,
    contacts: slice,
    geoms: Array | np.ndarray,
    rate: _PerContact,
    least: _PerContact,
) -> _Side | None:
    """Return for how long each contact pushes from its present side, and how it does from another; None if none can."""
    can_turn = ~are(model, geoms, WITHOUT_CENTRE).any(axis=1)
    if isinstance(can_turn, np.ndarray) and not can_turn.any():
        return None
    contact = jax.tree.map(lambda x: x[contacts], data._impl.contact)
    others, nearer = other_sides(model, data, contact, geoms)
    dim = block.rows_each // 2 + 1 if block.is_pyramid else block.rows_each
    turned = row_map(model, data, others, contacts.start, dim)
    turning = model.opt.timestep * jnp.abs(rate - _normal(block, turned.mv(data.qvel).reshape(-1, block.rows_each)))
    width = jnp.where(turning > 2 * least, turning, 2 * least)
    share = 0.5 + nearer / jnp.where(width > 0, width, 1.0)
    return _Side(jnp.where(can_turn & (width > 0) & (share < 1), jnp.where(share > 0.5, share, 0.5), 1.0), turned)


def _split(blocks: list[Block], shares: list[Float[Array, " _"]], sides: list[_Side | None]) -> Shares:
    """Return the shares in two solves, from φ of the rows and what may push instead of them."""
    # The first row of each stands for a contact or limit.
    each = [(np.arange(len(block.residual)), block.rows_each) for block in blocks]
    is_first = np.concatenate([row % num == 0 if num else np.zeros(len(row), bool) for row, num in each])
    whole, present = jnp.concatenate(shares), 1.0
    if any(side is not None for side in sides):
        present = jnp.concatenate(
            [
                jnp.ones_like(share) if side is None else per_row(side.share, block.rows_each)
                for block, share, side in zip(blocks, shares, sides, strict=True)
            ]
        )
    share = whole * present
    is_partial = (share > 0) & (share < 1)
    counts = jnp.where(is_partial & is_first, share * (1 - share), 0.0)
    total = jnp.sum(counts)
    is_split = total > 0
    # Without partial contacts the solve with p₊ is all there is.
    weight = jnp.where(is_split, jnp.sum(counts * share) / jnp.where(is_split, total, 1.0), 1.0)
    rest = jnp.where(is_split & (weight < 1), 1 - weight, 1.0)
    early, late = share - weight, share / weight
    before = jnp.where(early > 0, early / rest, 0.0)
    before = jnp.where((share == 1) | ~is_split, share, before)
    after = jnp.where(late < 1, late, 1.0)
    if isinstance(present, float):
        return Shares(before, after, weight, is_split, None)
    # Where it does not push from this side it does from the other; of both the larger share is left, less the smaller.
    turns = (present < 1) & is_split
    before, after = (jnp.where(turns, p - (1 - p) * whole, p) for p in (before, after))
    parts, start = [], 0
    for block, side in zip(blocks, sides, strict=True):
        rows = slice(start, start + len(block.residual))
        parts.append(None if side is None else _chosen(before[rows] < 0, side.map, block.map))
        start = rows.stop
    return Shares(jnp.abs(before), jnp.where(after > 0, after, 0.0), weight, is_split, tuple(parts))


def _chosen(is_other: Bool[Array, " rows"], other: RowMap, own: RowMap) -> RowMap:
    """Return a map with the rows of one where chosen and those of another elsewhere."""

    def choose(a: Array, b: Array) -> Array:
        if a is b:  # what both share, and is not by rows
            return b
        return jnp.where(is_other[:: len(is_other) // len(a)].reshape(-1, *(1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, other, own)
