r"""The slope of an outcome by MJX: motions from either side of each event, followed beside the motion itself.

The rule is that of `engines.events` and `engines.flight`, which say why: a change of the start moves a crossing of a surface to
another step. Differences of two motions that lie a step's travel apart say what that does, until the derivative along the motion
explains them. Here each motion has a few slots for such pairs, and everything has a fixed size, so that a GPU takes thousands of
motions at a time.

Of a pair, D is the difference of its motions over their distance at first, h what the event has felt of a change. A state's
derivative is that of the motion, x, and of all pairs together,

    whole = x + Σ D h,        x' = A (1 - P L) x + B u,        h' = h, or L x where a pair begins.

h is carried as a zero whose derivative it is, and D, P and L are constants to the derivative. So plain forward and reverse mode
of this program are the rule, and a pair's steps are not differentiated. Where nothing is differentiated, nothing is followed.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from mjxgrad._mjx import mjx
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.contact.collision import is_blind, slot_geoms
from mjxgrad.stepping.rows import Block
from mjxgrad.stepping.step import _smooth, step

NUM_SLOTS = 4
# As in `engines.events` and `engines.flight`.
_LEAST_WIDTH, _USUAL_WIDTH, _SMALLEST, _STIRRED, _STAGES = 0.06, 1e-3, 1e-6, 4.0, 1.2
_NO_JUMP, _FARTHEST = 0.01, 10.0
_NUM_ALIKE, _ALIKE, _FAR, _LONGEST, _BESIDE, _STEPS = 3, 0.05, 10.0, 100, 0.5, 10
_TINY = 1e-30

_Vector = Float[Array, " nv"]


class Flight(eqx.Module):
    """Pairs of motions in flight beside one motion.

    Attributes:
        qpos, qvel, act: both motions of each.
        widths: how far apart they began (m or rad); 0 where a slot is free.
        left: for how many steps they go on at most.
        alike: for how many steps the derivative of the motion has explained them.
        apart: D.
        held: h; zeros that have a derivative.
    """

    qpos: Float[Array, "slots 2 nq"]
    qvel: Float[Array, "slots 2 nv"]
    act: Float[Array, "slots 2 na"]
    widths: Float[Array, " slots"]
    left: Int[Array, " slots"]
    alike: Int[Array, " slots"]
    apart: Float[Array, "slots size"]
    held: Float[Array, " slots"]


def no_flight(model: mjx.Model, data: mjx.Data, num: int = NUM_SLOTS) -> Flight:
    """Return the room of a motion without pairs in flight."""
    zeros = lambda *shape: jnp.zeros(shape, data.qvel.dtype)  # noqa: E731
    size = 2 * model.nv + model.na
    return Flight(
        zeros(num, 2, model.nq),
        zeros(num, 2, model.nv),
        zeros(num, 2, model.na),
        zeros(num),
        jnp.zeros(num, jnp.int32),
        jnp.zeros(num, jnp.int32),
        zeros(num, size),
        zeros(num),
    )


@jax.custom_jvp
def _with_derivative_of(value, other):
    """Return the first argument, exactly, with the derivative of the second."""
    return value


@_with_derivative_of.defjvp
def _with_derivative_of_jvp(primals, tangents):
    return _with_derivative_of(*primals), tangents[1]


class Motion(NamedTuple):
    """What moves."""

    qpos: Array
    qvel: Array
    act: Array


def _changed(model: mjx.Model, motion: Motion, change: Float[Array, " size"]) -> Motion:
    """Return a motion changed in tangent space."""
    nv = model.nv
    return Motion(
        integrate_position(model, motion.qpos, change[:nv], 1.0),
        motion.qvel + change[nv : 2 * nv],
        motion.act + change[2 * nv :],
    )


def _with_change(model: mjx.Model, motion: Motion, change: Float[Array, " size"]) -> Motion:
    """Return a motion, exactly, with the derivative of one that is changed by zeros."""
    return Motion(*map(_with_derivative_of, motion, _changed(model, motion, change)))


def _difference(model: mjx.Model, start: Motion, end: Motion) -> Float[Array, " size"]:
    return jnp.concatenate(
        [position_change(model, start.qpos, end.qpos), end.qvel - start.qvel, end.act - start.act]
    )


def whole(model: mjx.Model, motion: Motion, flight: Flight) -> Motion:
    """Return a motion with the derivative of all that is in flight beside it."""
    return _with_change(model, motion, jax.lax.stop_gradient(flight.apart).T @ flight.held)


class _Near(NamedTuple):
    """Contacts and limits: J, gaps, what counts as near, and when they are crossed."""

    rows: Float[Array, "all nv"]
    gaps: Float[Array, " all"]
    centres: Float[Array, " all"]
    widths: Float[Array, " all"]
    times: Float[Array, " all"]
    chosen: Bool[Array, " all"]


def _gaps(blocks: list[Block]) -> Float[Array, " all"]:
    return jnp.concatenate([block.residual[:: block.rows_each] for block in blocks])


def _near(
    model: mjx.Model, data: mjx.Data, blocks: list[Block], after: _Vector, lengths: np.ndarray
) -> _Near:
    h, dtype = model.opt.timestep, data.qvel.dtype
    rows, solimp, blind = [], [], []
    for block in blocks:
        each = block.rows_each
        entries = block.map.matrix(model.nv).reshape(-1, each, model.nv)
        rows.append(jnp.mean(entries, axis=1) if block.is_pyramid else entries[:, 0])
        solimp.append(block.solimp[::each])
        if block.slots is None:
            blind.append(jnp.zeros(len(entries), bool))
        else:
            slots, contacts = slot_geoms(model, data), slice(*block.slots)
            geoms = (data._impl.contact.geom if slots is None else slots)[contacts]
            blind.append(jnp.asarray(is_blind(model, geoms)))
    rows, solimp, blind, gaps = jnp.concatenate(rows), jnp.concatenate(solimp), jnp.concatenate(blind), _gaps(blocks)
    rate = rows @ data.qvel
    speed = jnp.maximum(jnp.abs(rate), jnp.abs(rows @ after))
    centres, widths = jnp.zeros_like(gaps), 0.5 * h * speed
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        centres, widths = -0.5 * h * rate, _STAGES * widths
    kept = 1 / (1 + h * model.dof_damping * model.dof_invweight0)
    fall = h**2 * jnp.abs(rows @ (kept * data.qacc_smooth))
    width = solimp[:, 2]
    least = _LEAST_WIDTH * jnp.where(width > 0, jnp.minimum(width, _USUAL_WIDTH), _USUAL_WIDTH)
    smallest = _SMALLEST if dtype == jnp.float64 else 10 * _SMALLEST
    widths = jnp.maximum(widths, jnp.minimum(least, jnp.maximum(jnp.minimum(fall, _STIRRED * h * speed), smallest)))
    jumps = (solimp[:, 0] > _NO_JUMP) & (jnp.sum((rows / lengths) ** 2, axis=1) > 1 / _FARTHEST**2)
    inside = jnp.where(blind, (gaps < 0) & (gaps > -2 * widths), jnp.abs(gaps - centres) < widths)
    is_met = jnp.abs(gaps) < h * jnp.abs(rate)
    times = -jnp.where(is_met, gaps, 0.0) / jnp.where(is_met, rate, 1.0)
    return _Near(rows, gaps, centres, widths, times, inside & jumps)


class _Events(NamedTuple):
    """Modes of events; see `engines.events.Events`."""

    is_one: Bool[Array, " modes"]
    rows: Float[Array, "modes nv"]
    ahead: Float[Array, "modes nv"]
    moves: Float[Array, "nv modes"]
    middles: Float[Array, "nv modes"]
    widths: Float[Array, " modes"]
    weights: Float[Array, "modes events"]
    index: Int[Array, " events"]


def _by_modes(near: _Near, is_contact: np.ndarray, lengths: np.ndarray, count: int) -> _Events:
    """Return the chosen rows as modes, and displacements that change one alone and carry no other row across zero."""
    dtype = near.rows.dtype
    far = jnp.where(near.chosen, jnp.abs(near.gaps - near.centres) / near.widths, jnp.inf)
    _, index = jax.lax.top_k(-far, count)
    mask = near.chosen[index]
    scaled = near.rows / jnp.asarray(lengths, dtype)
    own = jnp.where(mask[:, None], scaled[index], 0.0)
    moved = (own != 0) & jnp.asarray(is_contact)[index][:, None]
    same = (moved.astype(dtype) @ moved.T.astype(dtype) > 0) | np.eye(count, dtype=bool)
    for _ in range(int(np.ceil(np.log2(max(count, 2))))):
        same = same.astype(dtype) @ same.astype(dtype) > 0
    squares, left = jnp.linalg.eigh(jnp.where(same, own @ own.T, 0.0))
    sizes, largest = jnp.sqrt(jnp.maximum(squares, 0.0)), jnp.max(jnp.abs(left), axis=0)
    group = same[jnp.argmax(jnp.abs(left), axis=0)]  # modes events
    is_one = largest * sizes > 1 / _FARTHEST
    weights = jnp.where(group & is_one[:, None] & mask, (largest * left).T, 0.0)
    widths = jnp.max(jnp.where(group & mask, near.widths[index], 0.0), axis=1)
    mode = weights @ own
    alike = group.astype(dtype) @ group.T.astype(dtype) > 0
    to_middle = jnp.where(alike, (weights @ (near.centres - near.gaps)[index])[:, None], 0.0)

    def moves_of(rest: Array) -> Array:
        gram = rest @ mode.T
        scale = jnp.where(is_one, 0.0, 1.0)
        return rest.T @ jnp.linalg.inv(gram + jnp.diag(scale))

    moves = moves_of(mode)
    reach = jnp.max(jnp.abs(scaled @ moves) * widths + jnp.abs(scaled @ (moves @ to_middle)), axis=1)
    is_own = jnp.zeros(len(far), bool).at[index].max(mask)
    margin = jnp.where((jnp.abs(near.gaps) < reach) & ~is_own, reach - jnp.abs(near.gaps), -1.0)
    most, held = jax.lax.top_k(margin, count)
    held = jnp.where(most[:, None] > 0, scaled[held], 0.0)
    gram = held @ held.T
    gram = gram + jnp.diag(jnp.where(most > 0, 1e-3 * jnp.diag(gram) + 1e-6, 1.0))
    rest = mode - (mode @ held.T) @ jnp.linalg.solve(gram, held)
    can_hold = jnp.all(~is_one | (jnp.sum(rest**2, axis=1) > 1 / _FARTHEST**2))
    moves = jnp.where(can_hold, moves_of(jnp.where(can_hold, rest, mode)), moves)
    by_coordinate = jnp.asarray(1 / lengths, dtype)[:, None]
    return _Events(
        is_one,
        mode * jnp.asarray(lengths, dtype),
        (weights * near.times[index]) @ near.rows[index],
        moves * by_coordinate,
        moves @ to_middle * by_coordinate,
        widths,
        weights,
        index,
    )


def advance(model: mjx.Model, data: mjx.Data, flight: Flight, lengths: tuple[float, ...]) -> tuple[mjx.Data, Flight]:
    """Take a motion, and what is in flight beside it, through a step of MuJoCo."""
    leaves, tree = jax.tree.flatten((model, data, flight))

    @jax.custom_jvp
    def run(*leaves):
        model, data, flight = jax.tree.unflatten(tree, leaves)
        return step(model, data), flight

    def jvp(primals, tangents):
        moving = [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

        def along(*values):
            every = [jax.lax.stop_gradient(x) for x in primals]
            for i, value in zip(moving, values, strict=True):
                every[i] = value
            return _advance(*jax.tree.unflatten(tree, every), np.array(lengths))

        return jax.jvp(along, tuple(primals[i] for i in moving), tuple(tangents[i] for i in moving))

    run.defjvp(jvp, symbolic_zeros=True)
    return run(*leaves)


def _put(data: mjx.Data, motion: Motion) -> mjx.Data:
    return data.replace(qpos=motion.qpos, qvel=motion.qvel, act=motion.act)


def _taken(data: mjx.Data) -> Motion:
    return Motion(data.qpos, data.qvel, data.act)


def _advance(model: mjx.Model, data: mjx.Data, flight: Flight, lengths: np.ndarray) -> tuple[mjx.Data, Flight]:
    fixed, still, pairs = jax.lax.stop_gradient((model, data, flight))
    nv, size, count, dtype = model.nv, flight.apart.shape[1], len(flight.widths), data.qvel.dtype
    now = _taken(still)
    h = fixed.opt.timestep
    scale = jnp.concatenate([jnp.asarray(lengths), _STEPS * h * jnp.asarray(lengths), jnp.zeros(size - 2 * nv)])
    scale = scale.astype(dtype)

    def moved_by(change: Float[Array, " size"]) -> Motion:
        return _taken(step(fixed, _put(still, _with_change(fixed, now, change))))

    moved, along = jax.linearize(moved_by, jnp.zeros(size, dtype))

    def tangent(change: Float[Array, " size"]) -> Float[Array, " size"]:
        rates = along(change)
        by_position = jax.jvp(lambda q: position_change(fixed, moved.qpos, q), (moved.qpos,), (rates.qpos,))[1]
        return jnp.concatenate([by_position, rates.qvel, rates.act])

    shown, blocks = _smooth(fixed, still)
    blocks = [block for block in blocks if block.rows_each]
    is_contact = np.concatenate([np.full(len(b.residual) // b.rows_each, b.slots is not None) for b in blocks])
    near = _near(fixed, shown, blocks, moved.qvel, lengths)
    events = _by_modes(near, is_contact, lengths, count)
    felt = jnp.concatenate([events.rows, events.ahead, jnp.zeros((count, size - 2 * nv), dtype)], axis=1)

    # Who is let go.
    far = jnp.linalg.norm(scale * pairs.apart, axis=1)
    known = pairs.alike >= _NUM_ALIKE
    live = (pairs.widths > 0) & (pairs.left > 0) & ~(known & (far <= _FAR))
    reach = jnp.abs(felt @ pairs.apart.T) * pairs.widths
    is_within = jnp.all(~events.is_one[:, None] | (reach <= 2 * events.widths[:, None]), axis=0)
    live &= ~(known & is_within & jnp.any(events.is_one))
    # Places of those that begin: free slots, then those of pairs that are least apart.
    order = jnp.argsort(jnp.where(live, far, -1.0))
    rank = jnp.cumsum(events.is_one) - 1
    place = (order[rank] == jnp.arange(count)[:, None]) & events.is_one  # slots modes
    begins = jnp.any(place, axis=1)
    live &= ~begins
    place = place.astype(dtype)

    # Both motions of all pairs, through this step.
    shift = events.moves * events.widths
    changes = jnp.stack([events.middles + shift, events.middles - shift], axis=1)  # nv 2 modes
    changes = jnp.einsum("vem,sm->sev", changes, place)
    started = jax.vmap(jax.vmap(lambda c: integrate_position(fixed, now.qpos, c, 1.0)))(changes)
    choose = lambda new, old: jnp.where(begins.reshape(-1, *(1,) * (old.ndim - 1)), new, old)  # noqa: E731
    is_used = begins | live
    idle = lambda ends, own: jnp.where(is_used.reshape(-1, *(1,) * (ends.ndim - 1)), ends, own)  # noqa: E731
    ends = Motion(*(idle(choose(new, old), new) for new, old in zip(
        (started, jnp.broadcast_to(now.qvel, pairs.qvel.shape), jnp.broadcast_to(now.act, pairs.act.shape)),
        (pairs.qpos, pairs.qvel, pairs.act), strict=True)))
    ends = jax.vmap(jax.vmap(lambda motion: _taken(step(fixed, _put(still, motion)))))(ends)
    widths = choose(place @ (2 * events.widths), pairs.widths) * is_used
    apart = jax.vmap(lambda pair: _difference(fixed, jax.tree.map(lambda x: x[1], pair), jax.tree.map(lambda x: x[0], pair)))(ends)
    apart = apart / jnp.where(widths > 0, widths, 1.0)[:, None]
    is_sound = jnp.all(jnp.isfinite(apart), axis=1)
    widths, apart = jnp.where(is_sound, widths, 0.0), jnp.where((widths > 0) & is_sound[..., None].squeeze(-1), apart.T, 0.0).T

    # Does the derivative along the motion explain them?
    by_felt = pairs.apart @ felt.T  # slots modes
    kept = pairs.apart.at[:, :nv].add(-by_felt @ events.moves.T)
    plain, clear = jax.vmap(tangent)(jnp.concatenate([pairs.apart, kept])).reshape(2, count, size)
    off = jnp.linalg.norm(scale * (apart - clear - by_felt @ (place.T @ apart)), axis=1)
    beside = jnp.linalg.norm(scale * (apart - plain), axis=1)
    is_beside = jnp.all(~events.is_one[:, None] | (reach <= _BESIDE * 2 * events.widths[:, None]), axis=0)
    off = jnp.where(is_beside, jnp.minimum(off, beside), off)
    is_alike = off <= _ALIKE * jnp.linalg.norm(scale * apart, axis=1)
    longest = 2 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else _LONGEST
    left = jnp.where(begins, longest, pairs.left) - 1
    alike = jnp.where(begins | ~is_alike, 0, pairs.alike + 1)

    apart, live, place, events, before = jax.tree.map(
        lambda x: checkpoint_name(x, SOLUTION), (apart, live, place, events, pairs.apart)
    )
    # What follows is differentiated.
    start = _taken(data)
    released = before.T @ jnp.where(live, 0.0, flight.held)
    start = _with_change(model, start, released)
    zero = _difference(fixed, now, start)
    by_model = _gaps([b for b in _smooth(model, data.replace(qpos=now.qpos, qvel=now.qvel, act=now.act))[1] if b.rows_each])
    by_model = (by_model - jax.lax.stop_gradient(by_model))[events.index]
    feels = events.rows @ zero[:nv] + events.ahead @ zero[nv : 2 * nv] + events.weights @ by_model
    feels = jnp.where(events.is_one, feels, 0.0)
    start = start._replace(
        qpos=_with_derivative_of(start.qpos, integrate_position(model, start.qpos, -events.moves @ feels, 1.0))
    )
    end = step(model, _put(data, start))
    held = jnp.where(live, flight.held, 0.0) + place @ feels
    return end, Flight(*ends, widths, left, alike, apart, held)
