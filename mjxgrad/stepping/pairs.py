r"""The slope of an outcome by MJX: motions from either side of each event, followed beside the motion itself.

The rule is that of `engines.events` and `engines.flight`, which say why. Here each motion has a few slots for pairs, and
everything has a fixed size, so that a GPU takes thousands of motions at a time. For each pair, D is the difference of its two
motions over how far apart they began, and h what its event has felt of a change. The change of a state is that along the motion,
x, and of all pairs together:

    whole = x + Σ D h,    x' = A (1 - P L) x + B u,    h' = h, or L x where a pair begins,    x += D h where one is let go.

h is carried as a zero that has a derivative, and D, P and L are constants to it. So forward and reverse mode of this program are
the rule; the motions of pairs are stepped, not differentiated. Where nothing is differentiated, no pair begins.

- A, along the motion, is one linear program; small differences of steps tell whether it explains a pair.
- Contacts and limits near their surface count in the order of their distance, as many as there are slots.
- A change of the model (a radius, a range) moves gaps, and L has the derivative of these.
- A pair takes a free slot, or that of one that is explained. Without, A serves its event, as if it were none.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from mjxgrad._arrays import with_derivative_of
from mjxgrad._mjx import mjx
from mjxgrad.batched import cholesky, linear
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.batched.maps import safe_norm
from mjxgrad.batched.sparse import sparsely
from mjxgrad.bodies import tree
from mjxgrad.bodies.kinematics import integrate_position, kinematics, position_change
from mjxgrad.contact.collision import is_blind, slot_geoms
from mjxgrad.stepping import assembly, slope
from mjxgrad.stepping.contact import Discrete
from mjxgrad.stepping.forward import advance, smooth

# A landing quadruped's gradient takes 6 times the discrete one's time with 4, 9 with 8, 16 with 16 (two cores). Of means
# after 0.2 s some are off by 3 standard errors with 4, none with 8.
NUM_SLOTS = 4
_LEAST_LENGTH = 1e-3  # of a lever, over the extent of the model
_COARSER = 10.0  # times, in single precision
_MOST_HELD, _NUM_HOLDS = 8, 3  # rows, and how often those are sought that a displacement would carry across zero
_LOOSE = 1e-3  # of the inverse inertia of rows that are held: they may depend on each other
# Small differences: of the farthest points (m, m/s). In single precision rounding is 0.4 % of them.
_SMALL, _SMALL_IN_SINGLE = (1e-7, 1e-5), (3e-5, 1e-3)
_FORCES = ("ctrl", "qfrc_applied", "xfrc_applied", "time", "qacc_warmstart")  # inputs that move nothing within a step

_Vector = Float[Array, " nv"]
_Change = Float[Array, " size"]
_Given = tuple[mjx.Model, Any]  # and data, or what has its motion; with None in place of leaves that are known


class Motion(NamedTuple):
    """Positions, velocities and activations."""

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    act: Float[Array, " na"]


class Flight(eqx.Module):
    """Pairs of motions in flight beside a motion."""

    ends: Motion  # both motions of each, with axes of slots and sides
    widths: Float[Array, " slots"]  # how far apart they began (m or rad); 0 in a free slot
    left: Int[Array, " slots"]  # for how many steps they may go on
    alike: Int[Array, " slots"]  # for how many steps the derivative along the motion has explained them
    apart: Float[Array, "slots size"]  # D, in tangent space
    held: Float[Array, " slots"]  # h; zeros whose derivative it is
    lengths: Float[Array, " nv"]  # how far each velocity moves the farthest point below it, at first (m or 1)


def no_flight(model: mjx.Model, data: mjx.Data) -> Flight:
    """Return free slots."""
    count, size, dtype = NUM_SLOTS, 2 * model.nv + model.na, data.qvel.dtype
    ends = Motion(*(jnp.zeros((count, 2, n), dtype) for n in (model.nq, model.nv, model.na)))
    none, steps, apart = jnp.zeros(count, dtype), jnp.zeros(count, jnp.int32), jnp.zeros((count, size), dtype)
    return Flight(ends, none, steps, steps, apart, none, jax.lax.stop_gradient(_lengths(model, data)))


def whole(model: mjx.Model, motion: Motion, flight: Flight) -> Motion:
    """Return a motion with the derivative of all that is in flight beside it."""
    return _with_change(model, motion, _in_flight(flight))


def without(model: mjx.Model, motion: Motion, flight: Flight) -> Motion:
    """Return a motion without the derivative of what is in flight beside it; the inverse of `whole`."""
    return _with_change(model, motion, -_in_flight(flight))


def _in_flight(flight: Flight) -> _Change:
    # NVIDIA GPUs would round the factors to ten bits, as in all products of a step.
    return jnp.matmul(jax.lax.stop_gradient(flight.apart).T, flight.held, precision="highest")


def taken(data: Any) -> Motion:
    """Return what moves of data."""
    return Motion(data.qpos, data.qvel, data.act)


def put(data: Any, motion: Motion) -> Any:
    """Return data with another motion."""
    return data.replace(**motion._asdict())


def follow(program: "Program", flight: Flight) -> tuple[Any, Flight]:
    """Take a motion, and what is in flight beside it, through a step; its derivative is then that along the motion alone."""

    @jax.custom_jvp
    def run(flight: Flight, given: _Given) -> tuple[Any, Flight]:
        return _as_batched(given[1].qpos, (program.step(given), flight))

    def differentiated(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        with jax.default_matmul_precision("highest"):
            found, rates = _Step(program, *primals).differentiate(*tangents)
        return tuple(_as_batched(primals[1][1].qpos, x) for x in (found, rates))

    run.defjvp(differentiated, symbolic_zeros=True)
    with jax.default_matmul_precision("highest"):
        moved, after = run(flight, program.given)
    return moved, eqx.tree_at(lambda x: x.held, jax.lax.stop_gradient(after), after.held)


class Program:
    """The step and the rows of a model and its data, as functions of the leaves that only the running program knows."""

    # Known leaves stay known, so that a step leaves out what a scene does not need. Functions are traced once for all uses.
    # Another engine has its own of both, and data with its own fields, which `replace` changes.

    def __init__(self, model: mjx.Model, data: Any, *, is_single: bool = False):
        self.is_single = is_single or data.qvel.dtype != jnp.float64
        self.has_stages = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        is_unknown = jax.tree.map(lambda x: isinstance(x, jax.core.Tracer), (model, data))
        is_given = _put_in(is_unknown, Motion(True, True, True))  # pyright: ignore[reportArgumentType]
        self.given, self.known = eqx.partition((model, data), is_given)
        self.step = jax.jit(lambda given: self.advance(*self.all_of(given)))
        self.rows = jax.jit(lambda given: self.near(*self.all_of(given)))

    def all_of(self, given: _Given) -> _Given:
        return eqx.combine(given, self.known)

    def advance(self, model: mjx.Model, data: Any) -> Any:
        """Return data one step later."""
        return advance(model, data, Discrete())

    def near(self, model: mjx.Model, data: Any) -> "Gaps | None":
        """Return the contacts and limits of data."""
        return gaps_of(model, smooth(model, data)[0])

    def near_after(self, given: _Given, ends: Any) -> "Gaps | None":
        """Return those of the state before a step, from the data after it."""
        # A step's data belongs to its state; that of several stages to the last of them.
        if self.has_stages:
            return self.rows(given)
        return gaps_of(self.all_of(given)[0], put(ends, taken(given[1])))

    def gap_rates(self, given: _Given, tangents: _Given, moving: Any) -> Float[Array, " all"]:
        """Return how gaps change with what moves surfaces beside the motion: sizes, places, ranges."""
        own, kept = eqx.partition(given, moving)
        gaps = lambda own: self.rows(eqx.combine(own, kept)).gaps  # noqa: E731
        return jax.jvp(gaps, (own,), (eqx.filter(tangents, moving),))[1]


def _put_in(given: _Given, motion: Motion) -> _Given:
    return given[0], put(given[1], motion)


class _Near(NamedTuple):
    """Contacts and limits: J, gaps, and which may begin or end in the step, with what they span and when."""

    rows: Float[Array, "all nv"]
    gaps: Float[Array, " all"]
    centres: Float[Array, " all"]
    widths: Float[Array, " all"]
    times: Float[Array, " all"]
    chosen: Bool[Array, " all"]
    is_contact: Bool[Array, " all"]


class _Events(NamedTuple):
    """Events by modes, as `engines.events.Events`; `is_one` says which are any, `weights` and `chosen` which rows take part."""

    is_one: Bool[Array, " modes"]
    rows: Float[Array, "modes nv"]
    ahead: Float[Array, "modes nv"]
    moves: Float[Array, "nv modes"]
    middles: Float[Array, "nv modes"]
    widths: Float[Array, " modes"]
    weights: Float[Array, "modes events"]
    chosen: Int[Array, " events"]


class _Plan(NamedTuple):
    """Which pairs go on, and which begin in which slot."""

    goes_on: Bool[Array, " slots"]
    begins: Bool[Array, " slots"]
    places: Float[Array, "slots modes"]


class _Step:
    """One step of a motion and of its pairs. All but the derivative along the motion is a constant to further derivatives."""

    def __init__(self, program: Program, flight: Flight, given: _Given):
        self.program, self.given = program, given
        self.flight, self.still = jax.lax.stop_gradient((flight, given))
        self.model, self.now = program.all_of(self.still)[0], taken(self.still[1])
        self.nv, self.size, self.dtype = self.model.nv, flight.apart.shape[1], self.now.qvel.dtype
        self.has_stages, self.is_single = program.has_stages, program.is_single

    def differentiate(self, given_flight: Flight, tangents: _Given) -> tuple[Any, Any]:
        """Return data and flight after the step, and the tangents of both."""
        program, flight, now = self.program, self.flight, taken(self.given[1])
        # Leaves, beside the motion, that have a tangent.
        others = jax.tree.map(lambda x: not isinstance(x, SymbolicZero), tangents)
        others = _put_in(others, Motion(False, False, False))  # pyright: ignore[reportArgumentType]
        (values, fixed), rates = eqx.partition(self.given, others), eqx.filter(tangents, others)

        def moved_by(change: _Change, values: _Given) -> tuple[Any, Any]:
            motion = _with_change(program.all_of(self.given)[0], now, change)
            step = program.step(_put_in(eqx.combine(values, fixed), motion))
            return eqx.partition(step, eqx.is_inexact_array)

        found, along, rest = jax.linearize(moved_by, jnp.zeros(self.size, self.dtype), values, has_aux=True)
        moved = eqx.combine(found, rest)
        change = self._tangent(now.qpos, taken(tangents[1]))
        heard = _dense(given_flight.held, flight.held)
        ends = jax.lax.stop_gradient(moved)
        rows = program.near_after(self.still, ends)
        after = flight
        if rows is not None:
            events, plan, after = self._followed(rows, ends)
            # All that follows is linear in tangents.
            change = change + flight.apart.T @ jnp.where(plan.goes_on, 0.0, heard)
            feels = events.rows @ change[: self.nv] + events.ahead @ change[self.nv : 2 * self.nv]
            moving = others[0], others[1].replace(**dict.fromkeys(_FORCES, False))
            if any(jax.tree.leaves(moving)):
                gap_rates = program.gap_rates(self.given, tangents, moving)
                feels = feels + events.weights @ gap_rates[events.chosen]
            change = change.at[: self.nv].add(-events.moves @ feels)
            heard = jnp.where(plan.goes_on, heard, 0.0) + plan.places @ feels
        still = jax.tree.map(_no_tangent, (moved, after))
        rates = eqx.combine(along(change, rates), still[0])
        return (moved, after), (rates, eqx.tree_at(lambda x: x.held, still[1], heard))

    def _followed(self, rows: "Gaps", moved: Any) -> tuple[_Events, _Plan, Flight]:
        """Return the events of the step, who goes on and who begins, and the flight after the step."""
        flight = self.flight
        near = self._near(rows, moved.qvel)
        events = sparsely(
            self._by_modes, jnp.any(near.chosen)[None], jax.tree.map(lambda x: x[None], near), flight.lengths
        )
        events = jax.tree.map(lambda x: x[0], events)
        events, plan, reach = self._plan(events)
        felt = flight.apart @ self._felt(events).T  # slots modes
        rest = flight.apart.at[:, : self.nv].add(-felt @ events.moves.T)
        ends, widths, apart, expected = self._go_on(events, plan, jnp.stack([flight.apart, rest], axis=1), taken(moved))
        is_alike = self._is_explained(events, plan, reach, apart, felt, expected)
        longest = slope.LONGEST_OF_STAGES if self.has_stages else slope.LONGEST
        left = jnp.where(plan.begins, longest, flight.left) - 1
        alike = jnp.where(plan.begins | ~is_alike, 0, flight.alike + 1)
        apart, plan, events = jax.tree.map(lambda x: checkpoint_name(x, SOLUTION), (apart, plan, events))
        return events, plan, Flight(ends, widths, left, alike, apart, flight.held, flight.lengths)

    def _tangent(self, qpos: Array, rates: Motion) -> _Change:
        by_position = jnp.zeros(self.nv, self.dtype)
        if not isinstance(rates.qpos, SymbolicZero):
            by_position = jax.jvp(lambda q: position_change(self.model, qpos, q), (qpos,), (rates.qpos,))[1]
        return jnp.concatenate([by_position, _dense(rates.qvel, self.now.qvel), _dense(rates.act, self.now.act)])

    def _scaled(self, change: Float[Array, "slots size"]) -> Float[Array, " slots"]:
        lengths = self.flight.lengths
        by_speed = slope.TRAVEL * self.model.opt.timestep * lengths
        scale = jnp.concatenate([lengths, by_speed, jnp.zeros(self.size - 2 * self.nv, self.dtype)])
        return jnp.linalg.norm(scale * change, axis=1)

    def _near(self, every: "Gaps", after: _Vector) -> _Near:
        """Return which contacts and limits may begin or end in the step, with the velocity after it."""
        model, h, rows, gaps, solimp = self.model, self.model.opt.timestep, every.rows, every.gaps, every.solimp
        rate = rows @ self.now.qvel
        speed = jnp.maximum(jnp.abs(rate), jnp.abs(rows @ after))
        centres, widths = jnp.zeros_like(gaps), 0.5 * h * speed
        if self.has_stages:
            centres, widths = -0.5 * h * rate, slope.STAGES * widths
        fall = h**2 * jnp.abs(rows @ (every.acceleration / (1 + h * model.dof_damping * model.dof_invweight0)))
        width = jnp.where(solimp[:, 2] > 0, jnp.minimum(solimp[:, 2], slope.USUAL_WIDTH), slope.USUAL_WIDTH)
        least = jnp.maximum(jnp.minimum(fall, slope.STIRRED * h * speed), slope.SMALLEST)
        widths = jnp.maximum(widths, jnp.minimum(slope.LEAST_WIDTH * width, least))
        jumps = (solimp[:, 0] > slope.NO_JUMP) & (
            jnp.sum((rows / self.flight.lengths) ** 2, axis=1) > 1 / slope.FARTHEST**2
        )
        # Without a distance outside, the step after the crossing meets it.
        is_near = jnp.where(every.is_blind, (gaps < 0) & (gaps > -2 * widths), jnp.abs(gaps - centres) < widths)
        is_met = jnp.abs(gaps) < h * jnp.abs(rate)
        times = -jnp.where(is_met, gaps, 0.0) / jnp.where(is_met, rate, 1.0)
        if self.is_single:  # pairs are farther apart, but what rests beside the window is no event
            widths = jnp.maximum(widths, _COARSER * slope.SMALLEST)
        return _Near(rows, gaps, centres, widths, times, is_near & jumps, every.is_contact)

    def _by_modes(self, near: _Near, lengths: _Vector) -> _Events:
        """Return the nearest as modes, and displacements that change one mode alone and carry no other row across zero."""
        count = min(len(self.flight.widths), len(near.gaps))
        far = jnp.where(near.chosen, jnp.abs(near.gaps - near.centres) / near.widths, jnp.inf)
        index = jax.lax.top_k(-far, count)[1]
        is_event, scaled = near.chosen[index], near.rows / lengths
        own = jnp.where(is_event[:, None], scaled[index], 0.0)
        # Contacts that share coordinates, also by others between them, belong together.
        shares = (own != 0) & near.is_contact[index][:, None]
        same = (shares[:, None] & shares).any(axis=2) | np.eye(count, dtype=bool)
        for _ in range(math.ceil(math.log2(count))):
            same = (same[:, :, None] & same).any(axis=1)
        squares, left = linear.eigh(jnp.where(same, own @ own.T, 0.0))
        largest = jnp.max(jnp.abs(left), axis=0)
        group = same[jnp.argmax(jnp.abs(left), axis=0)] & is_event  # of each mode
        is_one = largest * jnp.sqrt(jnp.maximum(squares, 0.0)) > 1 / slope.FARTHEST
        weights = jnp.where(group & is_one[:, None], (largest * left).T, 0.0)
        widths = jnp.max(jnp.where(group, near.widths[index], 0.0), axis=1)
        to_middle = weights @ (near.centres - near.gaps)[index]
        to_middle = jnp.where((group[:, None] & group).any(axis=2), to_middle[:, None], 0.0)
        mode = weights @ own
        is_free = ~jnp.zeros(len(far), bool).at[index].max(is_event)
        moves = self._moving(mode, is_one, scaled, jnp.where(is_free, jnp.abs(near.gaps), jnp.inf), widths, to_middle)
        is_one &= jnp.sum(moves**2, axis=0) < slope.FARTHEST**4  # modes that nothing changes alone
        mode, weights, moves = (jnp.where(is_one[:, None], x, 0.0) for x in (mode, weights, moves.T))
        moves = moves.T / lengths[:, None]
        ahead = (weights * near.times[index]) @ near.rows[index]
        return _Events(is_one, mode * lengths, ahead, moves, moves @ to_middle, widths, weights, index)

    def _moving(
        self, mode: Array, is_one: Array, scaled: Array, free: Float[Array, " all"], widths: Array, to_middle: Array
    ) -> Float[Array, "nv modes"]:
        """Return scaled displacements that change one mode alone and, where that can be, carry no free row across zero."""
        # `free` is how far from zero rows are that take no part in events, infinite of others; `to_middle` has, in
        # terms of all modes, the displacements to the middle of each.
        sizes = jnp.linalg.norm(scaled, axis=1)
        distance = jnp.where(sizes > 0, free / jnp.where(sizes > 0, sizes, 1.0), jnp.inf)
        nearest, kept = jax.lax.top_k(-distance, min(_MOST_HELD, len(distance)))
        rows, gaps, is_any = scaled[kept], free[kept], jnp.isfinite(nearest)
        gram, across = rows @ rows.T, rows @ mode.T
        unit, tiny = jnp.eye(len(mode), dtype=self.dtype), 10 * jnp.finfo(self.dtype).eps

        def alone(rest: Float[Array, "modes nv"]) -> Float[Array, "nv modes"]:
            square = jnp.where(is_one[:, None] & is_one, rest @ mode.T, 0.0)
            square += unit * (tiny * jnp.diag(square) + jnp.where(is_one, 0.0, 1.0))
            return cholesky.written_out(square[..., None], rest).T

        def holding(is_held: Bool[Array, " rows"]) -> Float[Array, "nv modes"]:
            # Rows that are held may depend on each other.
            held = jnp.where(is_held[:, None] & is_held, gram, 0.0)
            held += jnp.diag(jnp.where(is_held, _LOOSE * jnp.diag(gram), 1.0))
            rest = mode - cholesky.written_out(held[..., None], jnp.where(is_held[:, None], across, 0.0)).T @ rows
            # A mode that hardly moves without them carries them along.
            can_hold = jnp.all(~is_one | (jnp.sum(rest**2, axis=1) > 1 / slope.FARTHEST**2))
            return alone(jnp.where(can_hold, rest, mode))

        moves, is_held = alone(mode), jnp.zeros(len(rows), bool)
        for _ in range(_NUM_HOLDS):
            moved = rows @ moves
            is_held |= is_any & (gaps < jnp.max(jnp.abs(moved) * widths + jnp.abs(moved @ to_middle), axis=1))
            moves = holding(is_held)
        return moves

    def _felt(self, events: _Events) -> Float[Array, "modes size"]:
        return jnp.pad(jnp.hstack([events.rows, events.ahead]), ((0, 0), (0, self.size - 2 * self.nv)))

    def _plan(self, events: _Events) -> tuple[_Events, _Plan, Float[Array, "modes slots"]]:
        """Return the events that have a slot, who goes on and who begins, and how far apart at each event pairs are."""
        flight, is_one = self.flight, events.is_one
        far = self._scaled(flight.apart)
        is_known = flight.alike >= slope.NUM_ALIKE
        goes_on = (flight.widths > 0) & (flight.left > 0) & ~(is_known & (far <= slope.FAR))
        reach = jnp.abs(self._felt(events) @ flight.apart.T) * flight.widths
        is_within = jnp.all(~is_one[:, None] | (reach <= 2 * events.widths[:, None]), axis=0) & jnp.any(is_one)
        goes_on &= ~(is_known & is_within)
        # What is not explained keeps its slot: let go, its jump would be multiplied at each event that follows.
        order = jnp.argsort(jnp.where(goes_on, jnp.where(is_known, far, jnp.inf), -1.0))
        rank = jnp.cumsum(is_one) - 1
        is_one &= rank < jnp.sum(~goes_on | is_known)
        events = events._replace(is_one=is_one, moves=jnp.where(is_one, events.moves, 0.0))
        places = (order[jnp.clip(rank, 0, len(far) - 1)] == jnp.arange(len(far))[:, None]) & is_one
        begins = jnp.any(places, axis=1)
        return events, _Plan(goes_on & ~begins, begins, places.astype(self.dtype)), reach

    def _go_on(
        self, events: _Events, plan: _Plan, changes: Float[Array, "slots 2 size"], moved: Motion
    ) -> tuple[Motion, Array, Array, Float[Array, "slots 2 size"]]:
        """Return both motions of all pairs after the step, how far apart they began, D, and A times changes."""
        # A is known by small differences of the motion, which are two more motions to step: its linear program would
        # have to be compiled once more. Of changes, two for each slot, the second ones matter beside an event alone.
        flight = self.flight
        shift = events.moves * events.widths
        displaced = jnp.stack([events.middles + shift, events.middles - shift])  # sides nv modes
        displaced = jnp.einsum("evm,sm->sev", displaced, plan.places)
        displaced = jnp.pad(displaced, ((0, 0), (0, 0), (0, self.size - self.nv)))
        # A free slot repeats the motion.
        goes_on = plan.goes_on[:, None, None]
        ends = self._displaced(displaced)
        starts = Motion(*(jnp.where(goes_on, x, y) for x, y in zip(flight.ends, ends, strict=True)))
        small = self._small(changes)
        starts = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), starts, self._displaced(small * changes))
        both, is_any = plan.goes_on | plan.begins, jnp.any(events.is_one)
        is_wanted = jnp.stack([both, both, plan.goes_on, plan.goes_on & is_any], axis=1)

        def step(start: Motion, given: _Given) -> Motion:
            return taken(self.program.step(_put_in(given, start)))

        flat = jax.tree.map(lambda x: x.reshape(is_wanted.size, x.shape[-1]), starts)
        found = sparsely(step, is_wanted.ravel(), flat, self.still)
        ends = jax.tree.map(lambda x, y: x.reshape(y.shape), found, starts)
        one, other = (jax.tree.map(lambda x, side=side: x[:, side], ends) for side in (0, 1))
        widths = jnp.where(plan.goes_on, flight.widths, plan.places @ (2 * events.widths))
        apart = jax.vmap(self._difference)(one, other)
        is_sound = (widths > 0) & jnp.all(jnp.isfinite(apart), axis=1)
        apart = jnp.where(is_sound[:, None], apart, 0.0) / jnp.where(is_sound, widths, 1.0)[:, None]
        sides = jax.tree.map(lambda x: x[:, 2:], ends)
        away = jax.vmap(jax.vmap(lambda side: self._difference(side, moved)))(sides) / small
        expected = jnp.where(is_wanted[:, 2:, None], away, 0.0)
        ends = jax.tree.map(lambda x: x[:, :2], ends)
        expected = expected.at[:, 1].set(jnp.where(is_any, expected[:, 1], expected[:, 0]))
        return ends, jnp.where(is_sound, widths, 0.0), apart, expected

    def _displaced(self, changes: Float[Array, "slots 2 size"]) -> Motion:
        by_position, by_speed, by_act = jnp.split(changes, [self.nv, 2 * self.nv], axis=-1)
        qpos = jax.vmap(jax.vmap(lambda x: integrate_position(self.model, self.now.qpos, x, 1.0)))(by_position)
        return Motion(qpos, self.now.qvel + by_speed, self.now.act + by_act)

    def _small(self, changes: Float[Array, "slots 2 size"]) -> Float[Array, "slots 2 1"]:
        lengths, widths = self.flight.lengths, _SMALL_IN_SINGLE if self.is_single else _SMALL
        scale = jnp.concatenate(
            [lengths / widths[0], lengths / widths[1], jnp.full(self.size - 2 * self.nv, 1 / widths[1])]
        )
        largest = jnp.max(scale * jnp.abs(changes), axis=-1, keepdims=True)
        return 1 / jnp.where(largest > 0, largest, 1.0)

    def _difference(self, one: Motion, other: Motion) -> _Change:
        by_position = position_change(self.model, other.qpos, one.qpos)
        return jnp.concatenate([by_position, one.qvel - other.qvel, one.act - other.act])

    def _is_explained(
        self, events: _Events, plan: _Plan, reach: Array, apart: Array, felt: Array, expected: Array
    ) -> Bool[Array, " slots"]:
        """Return whether the derivative along the motion says how pairs differ, but for events that lie between the two."""
        plain, rest = expected[:, 0], expected[:, 1]
        off = self._scaled(apart - rest - felt @ (plan.places.T @ apart))
        is_beside = jnp.all(~events.is_one[:, None] | (reach <= 2 * slope.BESIDE * events.widths[:, None]), axis=0)
        off = jnp.where(is_beside, jnp.minimum(off, self._scaled(apart - plain)), off)
        return off <= slope.ALIKE * self._scaled(apart)


class Gaps(eqx.Module):
    """All contacts and limits of a state."""

    rows: Float[Array, "all nv"]  # J of their normals
    gaps: Float[Array, " all"]  # distances less margins (m or rad)
    solimp: Float[Array, "all 5"]  # their impedances
    is_blind: Bool[Array, " all"]  # whose distance is known only where they overlap
    acceleration: _Vector  # free motion, without contact
    is_contact: Bool[Array, " all"]


def gaps_of(model: mjx.Model, data: mjx.Data) -> Gaps | None:
    """Return all contacts and limits of data whose fields are those of its state; None if the scene has none."""
    blocks = assembly.gather(model, data)
    blocks = [block for block in blocks if block.rows_each]
    if not blocks:
        return None
    rows, blind = [], []
    for block in blocks:
        entries = block.map.matrix(model.nv).reshape(-1, block.rows_each, model.nv)
        rows.append(jnp.mean(entries, axis=1) if block.is_pyramid else entries[:, 0])
        blind.append(jnp.zeros(len(entries), bool))
        if block.slots is not None:
            slots, contacts = slot_geoms(model, data), slice(*block.slots)
            blind[-1] |= is_blind(model, (data._impl.contact.geom if slots is None else slots)[contacts])
    firsts = [(block.residual[:: block.rows_each], block.solimp[:: block.rows_each]) for block in blocks]
    gaps, solimp = (jnp.concatenate(x) for x in zip(*firsts, strict=True))
    kinds = np.repeat([block.slots is not None for block in blocks], [len(own) for own, _ in firsts])
    return Gaps(jnp.concatenate(rows), gaps, solimp, jnp.concatenate(blind), data.qacc_smooth, jnp.asarray(kinds))


def _lengths(model: mjx.Model, data: mjx.Data) -> _Vector:
    dtype = data.qvel.dtype
    data = kinematics(model, data.replace(qpos=jnp.asarray(model.qpos0, dtype)))
    joints = model.dof_jntid
    is_below = tree.moving_dofs(model)[model.geom_bodyid].astype(bool)
    size = jnp.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, 0.0, model.geom_rbound)
    far = safe_norm(data.geom_xpos[:, None] - data.xanchor[joints]) + size[:, None]
    lever = jnp.max(jnp.where(is_below, far, 0.0), axis=0, initial=_LEAST_LENGTH * model.stat.extent)
    kinds, places = model.jnt_type[joints], np.arange(model.nv) - model.jnt_dofadr[joints]
    is_straight = kinds == mujoco.mjtJoint.mjJNT_SLIDE
    is_straight |= (kinds == mujoco.mjtJoint.mjJNT_FREE) & (places < 3)
    return jnp.where(is_straight, 1.0, lever).astype(dtype)


def _with_change(model: mjx.Model, motion: Motion, change: _Change) -> Motion:
    """Return a motion, exactly, with the derivative of one to which a change of zero is added."""
    by_position, by_speed, by_act = jnp.split(change, [model.nv, 2 * model.nv])
    moved = integrate_position(model, motion.qpos, by_position, 1.0)
    return with_derivative_of(motion, Motion(moved, motion.qvel + by_speed, motion.act + by_act))


def _as_batched(qpos: Array, found: Any) -> Any:
    """Return what was found, as batched as positions are: of `jax.custom_jvp` both function and rule must be so."""
    is_any = qpos[0] == 0

    def batched(x: Any) -> Any:
        if x.dtype == jax.dtypes.float0:
            return x
        return jnp.where(is_any, x, x) if x.size else jnp.zeros(x.shape, x.dtype)

    return jax.tree.map(batched, found)


def _dense(tangent: Any, value: Array) -> Array:
    return jnp.zeros_like(value) if isinstance(tangent, SymbolicZero) else tangent


def _no_tangent(value: Array) -> Any:
    if jnp.issubdtype(value.dtype, jnp.inexact):
        return jnp.zeros_like(value)
    return np.zeros(value.shape, jax.dtypes.float0)
