r"""What automatic differentiation misses when a contact or a limit begins or ends.

MuJoCo's contact force jumps where contact begins (by default its impedance there is 0.9, not 0), and often where it ends, so
that the simulated outcome is a sawtooth in the state, see `onset`. Its derivative, the *discrete* one, is that of a tooth; that
of the motion is the slope across the teeth, and the jumps belong to it.

**The term.** Let e be a contact or limit (all its rows together), r its distance less the margin, v = ṙ = J_n q̇. A jump
lies where r = 0 in some step. Shift r at fixed velocities: the state passes such a place once for every h|v| of r, and the
velocity after that step then jumps by h (a₊ - a₋), the accelerations with and without e in contact at r = 0. Spread evenly
over the interval in which a step finds its event, a jump adds to the tangent of the velocity

    δv += -(a₊ - a₋) δr / |v|,        r < 0 ≤ r - h v at the beginning,  r - h v < 0 ≤ r at the end,

the saltation of the motion that MuJoCo's contact stands for as h → 0, and for semi-implicit steps, whose displacement is
exactly h v, the mean over all phases of the step for any h, as far as what follows is linear in the jump. Its value is
zero; it exists as a tangent only, in both modes, and simulating costs nothing.

**Several at once** all stand at r = 0 in contact in a₊. The difference is split by their forces λ_e:

    δv += -H⁻¹ Σ_e J_eᵀ λ_e δr_e / |v_e|,        H = M + Jᵀ S J,

S being, for the rows of all others, the slope of their force *between* the two accelerations: then H (a₊ - a₋) is exactly
Σ J_eᵀ λ_e, whatever the others do. With the slope at one end instead a foot that an impact elsewhere makes slip counts as
stuck: on gymnasium's ant the correction of a second landing is then off by half. Rows of elliptic cones act on each other, so
there S is the mean of their curvature along the way, by Gauss and Legendre, exact while they stay in a zone.

**Runge-Kutta** steps meet r = 0 in four stages, each with a jump of its own that later stages answer to. Here the
whole event is charged once, to the step across which r changes sign, with the state before it: contact then acts for the
rest of the step, half of it on average, and leaves (1 + h B d/2)⁻¹ of the impulse; half of it times h goes to the position.

**Grazing.** With |v| small an interval is short, and its term rare and huge; a product of several has no usable mean. Two
speeds say what is small. Below h |J_n a₋|, which free motion gains in one step, a crossing is not resolved in time, and which
side comes next is the step's choice. Below g / 2(B + √K) gravity presses a contact together faster than it approaches: an
edge that rolls almost unloaded hops by fractions of a micrometre, and the derivative of the hops says nothing of any noise
larger than they are. With u the larger of the two, 1/|v| is replaced by |v|/(v² + u²), which tends to zero: the discrete
derivative remains. The price is a bias for slow landings, (u/v)² of their term; u is 3 cm/s for MuJoCo's default contact.

**Nothing changes** for contacts that rest, slide or stick, since they do not cross r = 0; for a contact slot that goes over to
another pair of features, whose distance does not fit its own speed; where force begins at zero (d₀ = 0); and in
what is read of a step (`qacc`, forces, sensors), whose derivative stays the discrete one.

**Limits.** The jump is carried on by the tangent of the phase at hand, so contact should last some steps: on a
bounce the mean is right to a few per cent from about six steps on, and wrong below (`make bounce`). The spread over phases
remains, contacts that begin in the same step have no order, and where contacts chatter each multiplies the tangent. Where
MuJoCo's motion is not needed to the bit take `mjxgrad.Onset`, which is right sample by sample. A real discontinuity, hit or
miss, has no derivative: that needs zeroth order.

References:
    Aizerman, Gantmakher. On the stability of periodic motions. J. Appl. Math. Mech. 1958 (saltation). Kong, Payne, Zhu,
    Johnson. Saltation matrices: the essential tool for linearizing hybrid dynamical systems. arXiv:2306.06862.
"""

import dataclasses
import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import safe_sqrt
from mjxgrad._mjx import mjx
from mjxgrad.contact.law import Impedance, stiffness_damping
from mjxgrad.dynamics import assembly, constraint, implicit, linear
from mjxgrad.dynamics.constraint import Bend, RowLayout, Rows
from mjxgrad.dynamics.newton import System
from mjxgrad.dynamics.rows import Block, joined

_PerRow = Float[Array, " rows"]
_Truths = Bool[Array, " contacts"]
_PerContact = Float[Array, " contacts"]
_Vector = Float[Array, " nv"]
# Nodes and weights of Gauss and Legendre on (0, 1).
_NODES = 0.5 + 0.5 * np.polynomial.legendre.leggauss(3)[0]
_SHARES = 0.5 * np.polynomial.legendre.leggauss(3)[1]


@dataclasses.dataclass(frozen=True)
class _Plan:
    """What is static about the events of a step.

    Attributes:
        owner: the contact or limit that each row belongs to, -1 if it never begins or ends.
        is_spread: whether an event lies within the step, so that the contact damps its impulse for the rest of it.
    """

    layout: RowLayout
    max_iterations: int
    owner: tuple[int, ...]
    is_spread: bool


class _Events(eqx.Module):
    """The events of one step, and the state in which all of them are just in contact.

    Attributes:
        system: whose balance is the acceleration.
        damping: h B of each row that acts after the events; zero of others.
        normal: from joint velocities to the rate of distance.
        speed: of approach or retreat (m/s or rad/s).
        creep: speed below which gravity presses a contact together faster than it approaches (m/s).
    """

    system: System
    damping: _PerRow
    begins: _Truths
    ends: _Truths
    normal: Float[Array, "contacts nv"]
    speed: _PerContact
    creep: _PerContact
    start: _Vector
    timestep: Float[Array, ""]
    tolerance: Float[Array, ""]


def correct(model: mjx.Model, data: mjx.Data, blocks: list[Block]) -> mjx.Data:
    """Return solved data with the tangents of a semi-implicit step's events added to acceleration and constraint force."""
    if not any(block.rows_each for block in blocks):
        return data
    distance, normal = contacts_of(blocks, model.nv)
    before = distance - model.opt.timestep * (normal @ data.qvel)
    change, system = _change(model, data, blocks, normal, data.qvel, before, distance, is_spread=False)
    change = change / model.opt.timestep
    pushed = data.qfrc_constraint + system.inertia.apply(change)
    return data.replace(qacc=data.qacc + change, qfrc_constraint=pushed)


def impulse(model: mjx.Model, data: mjx.Data, blocks: list[Block], mean_velocity: _Vector) -> _Vector:
    """Return a change of velocity after a step, of value zero, with the tangents of the events within it.

    `data` is solved for the state before; the mean velocity leads from there to the state after.
    """
    if not any(block.rows_each for block in blocks):
        return jnp.zeros_like(data.qvel)
    distance, normal = contacts_of(blocks, model.nv)
    after = distance + model.opt.timestep * (normal @ mean_velocity)
    velocity = data.qvel + 0.5 * model.opt.timestep * data.qacc
    return _change(model, data, blocks, normal, velocity, distance, after, is_spread=True)[0]


def contacts_of(blocks: list[Block], num_dofs: int) -> tuple[_PerContact, Float[Array, "contacts nv"]]:
    """Return distance less margin, and normal row, of each contact and limit."""
    distance, normal = [], []
    for block in blocks:
        if not block.rows_each:
            continue
        matrix = block.map.matrix(num_dofs)
        jacobian = matrix.reshape(-1, block.rows_each, matrix.shape[1])
        distance.append(block.residual[:: block.rows_each])
        normal.append(jnp.mean(jacobian, axis=1) if block.is_pyramid else jacobian[:, 0])
    return jnp.concatenate(distance), jnp.concatenate(normal)


def _change(
    model: mjx.Model,
    data: mjx.Data,
    blocks: list[Block],
    normal: Float[Array, "contacts nv"],
    velocity: _Vector,
    before: _PerContact,
    after: _PerContact,
    *,
    is_spread: bool,
) -> tuple[_Vector, System]:
    """Return the change by events between two distances, and the state in which all of them are just in contact."""
    speed = normal @ velocity
    begins = (before >= 0) & (after < 0) & (speed < 0)
    ends = (before < 0) & (after >= 0) & (speed > 0)
    owner, count = [], 0
    for block in blocks:
        num_rows, each = len(block.residual), block.rows_each
        owner += [count + i // each for i in range(num_rows)] if each else [-1] * num_rows
        count += num_rows // each if each else 0
    plan = _Plan(assembly.row_layout(model, data), int(model.opt.iterations), tuple(owner), is_spread)
    rows, which = joined(blocks), _per_row(plan, begins | ends)
    # All events at zero distance, in contact.
    present = jnp.where(which, rows.impedance.onset, rows.impedance.present)
    impedance = Impedance(present, rows.impedance.full, rows.impedance.onset)
    residual = jnp.where(which, 0.0, rows.residual)
    touching = dataclasses.replace(rows, residual=residual, impedance=impedance, is_active=rows.is_active | which)
    damping = model.opt.timestep * stiffness_damping(model, touching.solref, touching.impedance.full)[1]
    events = _Events(
        system=assembly.system_of(model, data, plan.layout, touching, velocity=velocity),
        damping=jnp.where(_per_row(plan, ends), 0.0, damping),
        begins=begins,
        ends=ends,
        normal=normal,
        speed=jnp.abs(speed),
        creep=_creep(model, blocks),
        start=data.qacc,
        timestep=jnp.asarray(model.opt.timestep, velocity.dtype),
        tolerance=jnp.asarray(model.opt.tolerance, velocity.dtype),
    )
    return _impulse(plan, events, before if is_spread else after), events.system


def _creep(model: mjx.Model, blocks: list[Block]) -> _PerContact:
    """Return g / 2(B + √K) of each contact, and zero for limits, whose coordinate gravity may not be an acceleration of."""
    gravity, speeds = safe_sqrt(jnp.sum(model.opt.gravity**2)), []
    for block in blocks:
        if not block.rows_each:
            continue
        stiffness, damping = stiffness_damping(model, block.solref, block.impedance.full)
        rate = (damping + safe_sqrt(stiffness))[:: block.rows_each]
        share = gravity / (2 * jnp.where(rate > 0, rate, 1.0))
        speeds.append(jnp.where(rate > 0, share, 0.0) if block.is_contact else jnp.zeros_like(rate))
    return jnp.concatenate(speeds)


def _per_row(plan: _Plan, values: Array) -> Array:
    """Return per row what is given per contact, zero where rows never begin or end."""
    owner = np.asarray(plan.owner)
    return jnp.where(owner >= 0, values[np.maximum(owner, 0)], jnp.zeros((), values.dtype))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _impulse(plan: _Plan, events: _Events, distance: _PerContact) -> _Vector:
    """Return zero, whose tangent is the change of velocity by what later events leave out."""
    # Not a constant: under nested batches JAX (0.10.2) fails on a rule whose value has no batch and whose tangent has one.
    return 0 * events.start


@_impulse.defjvp
def _impulse_jvp(plan, primals, tangents):
    events, _ = primals
    system, is_event = events.system, _per_row(plan, events.begins | events.ends)
    without = _without(system, is_event)
    held, _ = implicit.solve(plan.layout, plan.max_iterations, system, events.start, events.tolerance)
    free, _ = implicit.solve(plan.layout, plan.max_iterations, without, held, events.tolerance)
    # By how much an event comes later per distance (s/m), less where the speed is not resolved.
    drift = events.timestep * (events.normal @ free)
    square = events.speed**2 + jnp.maximum(drift**2, events.creep**2)
    delay = events.speed / jnp.where(square > 0, square, 1.0)
    late = jnp.where(events.begins | events.ends, tangents[1] * delay, 0.0)
    lost = system.pull(system.row_force(plan.layout, held) * _per_row(plan, late))
    start, stop = (without.rates(a) - without.rows.reference for a in (free, held))
    change = -implicit.respond(plan.layout, without, _secant_bend(plan.layout, without.rows, start, stop), lost)
    if plan.is_spread:
        change = _damped(plan, events, held, change)
    return 0 * events.start, change


def _without(system: System, which: Bool[Array, " rows"]) -> System:
    return eqx.tree_at(lambda s: s.rows.weight, system, jnp.where(which, 0.0, system.rows.weight))


def _secant_bend(layout: RowLayout, rows: Rows, start: _PerRow, stop: _PerRow) -> Bend:
    """Return the curvature averaged between two points, by which the forces at both differ."""
    moved = stop - start
    is_far = jnp.abs(moved) > jnp.sqrt(jnp.finfo(moved.dtype).eps) * (jnp.abs(start) + jnp.abs(stop))
    gained = constraint.force(layout, rows, start) - constraint.force(layout, rows, stop)
    secant = gained / jnp.where(is_far, moved, 1.0)
    curved, simple = constraint.bend(layout, rows, stop), slice(layout.simple_stop)
    # The rows of a cone act on each other: no quotient gives their matrix.
    between = [constraint.bend(layout, rows, start + t * moved).cones for t in _NODES] if layout.cones else []
    means = [
        linear.add(s * matrix for s, matrix in zip(_SHARES, each, strict=True)) for each in zip(*between, strict=True)
    ]
    return Bend(jnp.where(is_far[simple], secant[simple], curved.simple), tuple(means))


def _damped(plan: _Plan, events: _Events, acceleration: _Vector, change: _Vector) -> _Vector:
    """Return what contacts leave of a change of velocity in half a time step, by the implicit midpoint rule."""
    after = _without(events.system, _per_row(plan, events.ends))
    bend = constraint.bend(plan.layout, after.rows, after.rates(acceleration) - after.rows.reference)
    # The curvature times the damping of the rows, symmetric.
    damping, cones = 0.5 * events.damping, []
    for group, matrix in zip(plan.layout.cones, bend.cones, strict=True):
        own = damping[group.start : group.stop].reshape(group.count, group.dim)
        cones.append(0.5 * matrix * (own[:, :, None] + own[:, None]))
    resisting = Bend(bend.simple * damping[: plan.layout.simple_stop], tuple(cones))
    whole = jax.tree.map(operator.add, bend, resisting)
    resistance = after.pull(constraint.bend_product(plan.layout, resisting, after.rates(change)))
    return change - implicit.respond(plan.layout, after, whole, resistance)
