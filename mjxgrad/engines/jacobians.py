"""Derivatives of single steps of C MuJoCo, on one thread: from the solution where that has all, else from whole steps.

For a slope they know of the events near a step, see `engines.events`.
"""

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjxgrad._interrupts import give_up_if_stopped
from mjxgrad.engines import inverse
from mjxgrad.engines.events import HAIR, Events, Near, Surfaces, clearance, undecided
from mjxgrad.engines.flight import FIRST, PAIRS, Begun
from mjxgrad.engines.inverse import Inverse
from mjxgrad.engines.layout import EVERY, INPUTS, Layout
from mjxgrad.engines.steps import Stepper
from mjxgrad.scene.numbers import PARAMETERS
from mjxgrad.stepping import slope

# Stages of a step that are done.
_NONE, _PLACES, _SPEEDS = (getattr(mujoco.mjtStage, f"mjSTAGE_{name}").value for name in ("NONE", "POS", "VEL"))
# What sensors of places read, without collisions; and those of velocities.
_PLACED = (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex, mujoco.mj_tendon, mujoco.mj_transmission,
           mujoco.mj_sensorPos)  # fmt: skip
_MOVED = (mujoco.mj_fwdPosition, mujoco.mj_sensorPos, mujoco.mj_fwdVelocity, mujoco.mj_sensorVel)
WIDTH = 1e-6  # of small differences of whole steps, as MuJoCo's documentation has it; of parameters as a share of their value
_NARROW = 4e-9  # of those by inverse dynamics, with room
_ONE_SIDE = 1e-7  # of differences to one side: their error is in proportion
# How the names of model arrays and inputs end that move surfaces.
_SHAPES = ("size", "pos", "quat", "axis", "range", "margin", "gap", "qpos0", "vert", "data")
_RUBBING = 1e-3  # m/s or rad/s, of differences by velocities, and by what is no position, where edges or corners touch
_NOTHING = 1e-9  # of a displacement by one
# Numbers of a model that are rounding beside the others of their row, as where a file's degrees are turned; short lengths (m).
_BESIDE_ROW, _SHORT = 1e-6, 1e-3
# Over a time step. A contact of two steps, the shortest, is as steep as 1/4: steeper differences step over a jump.
_STEEP, _NARROWER, _WIDER = 1.0, 1 / 30, 30.0
_NEARLY = 0.1  # of what is too steep, from which columns beside such a one are differenced, too
# Of the steps that are subtracted: what a solve leaves is divided by the width, and so is what a search for a contact leaves.
_TOLERANCE, _ITERATIONS = 1e-16, 200
_CONTACT_TOLERANCE = 1e-14  # m
APART = 0.5  # of the larger side's difference, by which the two sides differ where one has a jump
_OF_TIME = "opt.timestep"
_ROUNDING = 1e-10  # of forces and of states
_KINK = 0.1  # of a derivative, by which its two sides differ at most
_BEND = 1e-3  # of a derivative, by which its sides differ at most where nothing begins or ends between
_TOGETHER = 64  # rows whose algebra is done at once

_Found = dict[str, np.ndarray]


def solved(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy whose solves leave nothing to see."""
    model = copy.deepcopy(model)
    model.opt.tolerance, model.opt.iterations = _TOLERANCE, max(_ITERATIONS, model.opt.iterations)
    # At the usual 1e-6 m points on the edges of cylinders jump with every change of a state.
    model.opt.ccd_tolerance = min(_CONTACT_TOLERANCE, model.opt.ccd_tolerance)
    model.opt.ccd_iterations = max(_ITERATIONS, model.opt.ccd_iterations)
    if inverse.has_inverse(model):
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # the solution is one, whoever finds it
    return model


@dataclass
class Steps:
    """Steps to be differentiated, and what is found of them."""

    rows: Float[np.ndarray, "rows size"]  # whole states of MuJoCo before each
    models: list[mujoco.MjModel]  # one of each, shared where they are the same
    speeds: Mapping[int, Float[np.ndarray, "some nv"]]  # velocities that the motions of each model reach
    gradient: str  # "discrete" or "slope"
    found: _Found  # arrays to be written, by name, with one entry per row
    is_finite: Bool[np.ndarray, " rows"]  # whether a step ends in numbers
    rates: Mapping[int, Mapping[str, np.ndarray]]  # of fields of each model by its parameters
    begun: dict[int, Begun] = field(default_factory=dict)  # pairs that begin, by row
    # Other models than given, where rounding decides if a contact acts.
    chosen: dict[int, mujoco.MjModel] = field(default_factory=dict)


@dataclass
class _Row:
    """A step of which derivatives are taken: its state, its end and acceleration, and where they are taken."""

    before: Float[np.ndarray, " size"]  # whole states before and after the step
    after: Float[np.ndarray, " size"]  # whole states before and after the step
    found: _Found  # its part of what is to be written
    raw: _Found  # derivatives of R, inputs first
    by: Inverse  # inverse dynamics, also of another model where rounding decides
    clear: Float[np.ndarray, " size"]  # the state about which no small difference crosses a surface
    acceleration: Float[np.ndarray, " nv"]  # the step's from there
    near: Near | None = None  # surfaces near the state
    begun: Begun | None = None  # pairs of motions that its events begin
    is_explicit: bool = False  # whether R has all that the step does
    is_solved: bool = True  # whether the step's solver came to an end

    @property
    def events(self) -> Events | None:
        return None if self.near is None else self.near.events


class Worker:
    """The derivatives of one thread, which keeps its memory and its copy of a model."""

    def __init__(self, layout: Layout, levers: np.ndarray):
        self.layout, self.levers, self.given = layout, levers, None

    @np.errstate(invalid="ignore", over="ignore", divide="ignore")
    def fill(self, steps: Steps, index: list[int]) -> None:
        """Write the derivatives of chosen rows, those of one model together."""
        for model, group in itertools.groupby(index, key=lambda i: id(steps.models[i])):
            self._use(steps.models[(rows := list(group))[0]], steps.speeds[model], steps.gradient)
            self.rates = steps.rates[model]
            for begin in range(0, len(rows), _TOGETHER):
                give_up_if_stopped()
                self._together(steps, rows[begin : begin + _TOGETHER])

    def _use(self, given: mujoco.MjModel, speeds: np.ndarray, gradient: str) -> None:
        """Take a model for what follows, whose motions move so fast."""
        if given is not self.given:
            self.given, self.model, self.others = given, copy.deepcopy(given), None
            self.inverse, self.is_explicit = Inverse(self.model, self.layout), inverse.has_inverse(self.model)
            self.sensed = _sensed(self.model)
            self.placed = (mujoco.mj_kinematics, mujoco.mj_sensorPos) if _are_frames(self.model) else _PLACED
            self.surfaces = Surfaces(self.model, self.levers)
            self.far, self.stepper = mujoco.MjData(self.surfaces.model), Stepper(self.model, self.layout, 1)
        self.surfaces.widen(speeds if gradient == "slope" else 0 * speeds)

    @np.errstate(invalid="ignore", over="ignore")
    def differences(self, model: mujoco.MjModel, row: np.ndarray, found: _Found, num_steps: int) -> bool:
        """Write the end of a motion and its differences by state and held controls, all in C; return whether they are right."""
        # `mjd_transitionFD` is not where forces by controls change the integrator's matrix, and at surfaces, where it is steep.
        self._use(model, np.zeros((0, self.layout.nv)), "discrete")
        if self.inverse.is_coupled or not self.is_explicit:
            return False
        data, size = self.inverse.data, self.layout.num_changes
        A, B = np.zeros((num_steps, size, size)), np.zeros((num_steps, size, self.model.nu))
        mujoco.mj_setState(self.model, data, row, EVERY)
        for by_state, by_control in zip(A, B, strict=True):
            mujoco.mjd_transitionFD(self.model, data, _ONE_SIDE, False, by_state, by_control, None, None)
            if self._is_steep(by_state):
                return False
            mujoco.mj_step(self.model, data)
        matrix = np.eye(size, size + self.model.nu)
        for by_state, by_control in zip(A, B, strict=True):
            matrix = by_state @ matrix
            matrix[:, size:] += by_control
        mujoco.mj_getState(self.model, data, end := np.empty_like(row), EVERY)
        found["state"][:], found["ctrl"][:] = np.split(matrix, [size], axis=1)
        found["end"][:] = end[self.layout.motion]
        return bool(np.isfinite(end).all())

    def _together(self, steps: Steps, index: list[int]) -> None:
        """Write the derivatives of rows of one model: differences one by one, the algebra at once."""
        names = ["ctrl", *(name for name in steps.found if is_other(name))]
        raw, done = self._memory(steps, names, len(index)), []
        for k, i in enumerate(index):
            one = self._begun(steps, i, {name: value[k] for name, value in raw.items()})
            if one is not None:
                steps.is_finite[i] = True
                self._differentiate(one, names)
                done.append((k, i, one))
        explicit = [(k, one) for k, _, one in done if one.is_explicit]
        self._assemble(raw, explicit, names)
        for _, i, one in done:
            if one.is_explicit and one.is_solved and self._is_steep(one.found["state"]):
                self._beside(steps.gradient, one, names)
            self._with_events(one)
            if one.begun is not None:
                steps.begun[i] = one.begun
            if one.by is not self.inverse:
                steps.chosen[i] = one.by.model

    def _memory(self, steps: Steps, names: list[str], count: int) -> _Found:
        shapes = inverse.shapes(self.model)
        for name in names[1:]:
            columns = steps.found[name].shape[-1]
            shapes |= {name: (columns, self.layout.nv), f"shift {name}": (columns, self.layout.nv)}
            shapes |= {f"next {name}": (columns, self.model.na)}
        raw = {name: np.zeros((count, *shape)) for name, shape in shapes.items()}
        raw["qacc"][:] = np.eye(self.layout.nv)
        return raw

    def _assemble(self, raw: _Found, rows: list[tuple[int, _Row]], names: list[str]) -> None:
        if not rows:
            return
        chosen = [k for k, _ in rows]
        speeds = np.array([one.after[self.layout.places["qvel"]] for _, one in rows])
        own = {name: value[chosen] for name, value in raw.items()}
        parts = inverse.step_of(self.layout, self.model.opt.timestep, speeds, own, names)
        for k, (_, one) in enumerate(rows):
            for name, value in parts.items():
                if name in one.found and name != _OF_TIME:  # which whole steps have given
                    one.found[name][:] = value[k]

    def _begun(self, steps: Steps, i: int, raw: _Found) -> _Row | None:
        """Return a step with what is near it and what begins there, or None if it does not end in numbers."""
        found, row = {name: value[i] for name, value in steps.found.items()}, steps.rows[i].copy()
        if not np.isfinite(row).all() or not np.isfinite(after := self._step(self.inverse, row)).all():
            return None
        is_solved = bool(self.inverse.data.solver_niter.max() < self.model.opt.iterations)
        one = _Row(row, after, found, raw, self.inverse, row, self._acceleration(row, after), is_solved=is_solved)
        row[self.layout.places["warmstart"]] = after[self.layout.places["warmstart"]]
        if steps.gradient == "slope":
            self._look(one)
        elif not self.is_explicit:
            self._aside(one)
        return one

    def _look(self, one: _Row) -> None:
        """Find the events near a state, and the motions from either side of them."""
        speed = self.layout.places["qvel"]
        mujoco.mj_setState(self.surfaces.model, self.far, one.before, EVERY)
        near = self.surfaces.near(self.far, one.before[speed], one.after[speed], self.inverse.data.qacc_smooth)
        if near is None:
            return
        one.near = near
        if near.is_undecided:
            self._decide(one)
        if (events := near.events) is None:
            return
        one.begun = self._pairs(one, events)
        if not np.isfinite(one.begun.apart).all():  # a step from beside this state may end nowhere
            one.near, one.begun = dataclasses.replace(near, events=None), None
            return
        small = _NARROW if self.is_explicit else WIDTH
        shift = clearance(small, events.surfaces, events.gaps, events.centres)
        if shift.any():
            self._move(one, shift)
        if self.surfaces.has_stages:
            for move, rates in zip(events.moves.T, events.rows, strict=True):
                one.clear = self._off_stages(one, WIDTH * np.abs(rates).max() * move)

    def _aside(self, one: _Row) -> None:
        """Take small differences about a state from which they cross no surface, and with gaps of rounding's size as they are."""
        mujoco.mj_setState(self.surfaces.model, self.far, one.before, EVERY)
        shift, is_undecided = self.surfaces.beside(_NARROW if self.is_explicit else WIDTH, self.far)
        if is_undecided:
            self._decide(one)
        if shift is not None:
            self._move(one, shift)

    def _beside(self, gradient: str, one: _Row, names: list[str]) -> None:
        """Differentiate a step anew whose differences are too steep: from beside, and at last by whole steps."""
        if gradient == "discrete":
            self._aside(one)
            if one.clear is not one.before or one.by is not self.inverse:
                raw = {name: value[None] for name, value in one.raw.items()}
                for value in raw.values():
                    value[:] = 0.0
                self._differentiate(one, names)
                self._assemble(raw, [(0, one)] * one.is_explicit, names)
        matrix, nv = one.found["state"], self.layout.nv
        if one.is_explicit and self._is_steep(matrix):
            columns = np.flatnonzero(~(self._steepness(matrix) <= _NEARLY * _STEEP / self.model.opt.timestep))
            others = matrix.copy()
            others[:, columns] = self._smooth(one, np.eye(nv, len(matrix))[columns], self._width(one)).T
            if self._steepness(others).max() < 0.5 * self._steepness(matrix).max():
                matrix[:] = others

    def _decide(self, one: _Row) -> None:
        """Take the model in which gaps of the size of rounding are as they were in the step."""
        if self.others is None:
            self.others = [Inverse(model, self.layout) for model in undecided(self.model)]
        speed = self.layout.places["qvel"]
        one.by = min(self.others, key=lambda by: np.abs(self._step(by, one.before)[speed] - one.after[speed]).max())

    def _move(self, one: _Row, shift: Float[np.ndarray, " nv"]) -> None:
        one.clear = self.layout.moved(one.before, shift)
        one.acceleration = self._acceleration(one.clear, self._step(one.by, one.clear))

    def _acceleration(self, before: np.ndarray, after: np.ndarray) -> Float[np.ndarray, " nv"]:
        speed = self.layout.places["qvel"]
        return (after[speed] - before[speed]) / self.model.opt.timestep

    def _pairs(self, one: _Row, events: Events) -> Begun:
        """Return the two motions that span each event, after one step."""
        layout, widths = self.layout, events.widths
        sides = np.array([1.0, -1.0])
        moves = events.middles.T[:, None] + (widths[:, None] * sides)[..., None] * events.moves.T[:, None]
        starts = layout.moved(one.before, moves)
        ends = self._steps(one.by, starts)
        felt = np.pad(np.hstack([events.rows, events.ahead]), ((0, 0), (0, layout.num_rest)))
        apart = layout.difference(ends[:, 0], ends[:, 1]) / (2 * widths)[:, None]
        begun = Begun(felt, ends[..., layout.motion], 2 * widths, apart, np.zeros_like(apart).T)
        begun.longest = slope.LONGEST_OF_STAGES if self.surfaces.has_stages else slope.LONGEST
        return begun

    def _differentiate(self, one: _Row, names: list[str]) -> None:
        """Write small differences by all that is wanted: those of R, or where that lacks something those of whole steps."""
        if self.is_explicit:
            # Differences of whole steps that found no end are noise; those of R at what they found are not.
            one.is_explicit = one.by.blocks(one.clear, one.acceleration, one.raw) or not one.is_solved
        if not one.is_explicit:
            self._by_steps(one)
        self._by_others(one, names[1:])

    def _with_events(self, one: _Row) -> None:
        """Replace what small differences have along the displacements of events, and average the geometry of edges."""
        events, matrix, nv = one.events, one.found["state"], self.layout.nv
        if one.near is None:
            return
        rest = np.eye(nv)
        if events is not None and one.begun is not None:
            rest -= events.moves @ events.rows
            lost = matrix[:, :nv] @ events.moves
            matrix[:, nv : 2 * nv] -= lost @ events.ahead
            one.begun.lost = lost
        if len(one.near.rough):
            by_rest = matrix[:, :nv] @ rest
            visible = by_rest.copy()
            self._visibly(one, rest, visible)
            # Beyond any contact's stiffness are points of contact that jump, by as much however close to a surface one looks.
            steep = self._steepness(visible) > _STEEP / self.model.opt.timestep
            steep &= self._steepness(by_rest) <= _STEEP / self.model.opt.timestep
            matrix[:, :nv] = np.where(steep, by_rest, visible)
        elif events is not None:
            matrix[:, :nv] = matrix[:, :nv] @ rest
        if one.begun is not None and "apart" not in one.found:  # nobody follows them
            matrix += one.begun.apart.T @ one.begun.felt

    def _visibly(self, one: _Row, rest: Float[np.ndarray, "nv nv"], found: Float[np.ndarray, "size nv"]) -> None:
        """Write derivatives along displacements by as much as moves surfaces visibly, where they move a rough contact."""
        layout, near, places = self.layout, one.near, self.layout.places
        assert near is not None
        sizes = np.abs(rest).max(axis=0)
        found[:, sizes < _NOTHING] = 0.0  # what an event leaves of a coordinate that moves it alone
        moving = np.flatnonzero((sizes >= _NOTHING) & (np.abs(rest[near.rough]).max(axis=0, initial=0.0) >= _NOTHING))
        directions = rest[:, moving].T
        if not len(moving):
            return
        widths = near.widths(directions)
        changes = widths[:, None, None] * np.array([1.0, -1.0])[:, None] * directions[:, None]
        starts = layout.moved(one.clear, changes)
        if not one.is_explicit:
            ends = self._steps(one.by, starts)
            found[:, moving] = (layout.difference(ends[:, 0], ends[:, 1]) / (2 * widths)[:, None]).T
            return
        ends = one.by.solutions(
            one.clear, one.acceleration, one.raw["qacc"], starts[..., places["qpos"]].reshape(-1, self.model.nq)
        )
        ends = ends.reshape(len(moving), 2, layout.nv)
        timestep = self.model.opt.timestep
        change = timestep * ((ends[:, 0] - ends[:, 1]) / (2 * widths)[:, None]).T
        turned = timestep * one.after[places["qvel"]]
        found[: layout.nv, moving] = layout.carry(turned, directions.T) + layout.follow(turned, timestep * change)
        found[layout.nv : 2 * layout.nv, moving] = change

    def _by_steps(self, one: _Row) -> None:
        """Write differences of whole steps by state and controls."""
        layout, width = self.layout, self._width(one)
        one.found["state"][:] = self._smooth(one, np.eye(layout.num_changes), width).T
        if "ctrl" in one.found:
            place = layout.places["ctrl"]
            entries = np.arange(place.start, place.stop)
            up, down, size = one.by.sides(one.clear[entries], width)
            starts = np.tile(one.clear, (len(entries), 2, 1))
            starts[np.arange(len(entries)), :, entries] = np.stack([up, down], axis=1)
            one.found["ctrl"][:] = self._between(one, starts, size).T

    def _width(self, one: _Row) -> float:
        """Return the width of differences of whole steps."""
        return WIDTH if one.near is None or not len(one.near.rough) or self.surfaces.has_stages else _RUBBING

    def _smooth(self, one: _Row, directions: Float[np.ndarray, "columns changes"], width: float) -> np.ndarray:
        """Return differences along directions, over one side where the other has a jump, and narrower or wider where both have.

        A surface that is near has one jump. The points at which a bottle stands on a table jump with every turn: then all are
        averaged over.
        """
        # A stage of Runge-Kutta may meet a surface that the start is far from.
        is_own = one.clear is one.before and one.by is self.inverse
        middle = one.after if is_own else self._step(one.by, one.clear)
        wider = (_WIDER, _WIDER**2) if width < _RUBBING else ()
        others, steepest = np.array((_NARROWER, _NARROWER**2, *wider)), 1 / self.model.opt.timestep
        found, sizes = np.zeros_like(directions), np.full(len(directions), np.inf)
        left, had_jump = np.arange(len(sizes)), np.zeros(len(sizes), bool)
        every = self._sides(one, middle, directions, np.array([width]))
        for number, factor in enumerate((1.0, *others)):
            if number == 1:  # what needs another width often needs the last
                every = np.zeros((1 + len(others), *every.shape[1:]))
                every[1:, left] = self._sides(one, middle, directions[left], width * others)
            sides = every[number, left]
            both, size = np.linalg.norm(sides, axis=2), np.linalg.norm(sides[:, 0] - sides[:, 1], axis=1)
            jumps = (size > APART * both.max(axis=1)) & (both.max(axis=1) > steepest)
            least = np.take_along_axis(sides, both.argmin(axis=1)[:, None, None], axis=1)[:, 0]
            chosen = np.where(jumps[:, None], least, sides.mean(axis=1))
            size = np.linalg.norm(chosen, axis=1)
            is_better = (size < 0.5 * sizes[left]) | (had_jump[left] & ~jumps)
            index = left[is_better]
            found[index], sizes[index], had_jump[index] = chosen[is_better], size[is_better], jumps[is_better]
            left = left[jumps | (size > steepest) | (factor > 1.0)]
            if not left.size:
                break
        return found

    def _sides(
        self, one: _Row, middle: np.ndarray, directions: Float[np.ndarray, "columns changes"], widths: np.ndarray
    ) -> Float[np.ndarray, "widths columns 2 changes"]:
        """Return differences along directions to either side."""
        changes = widths[:, None, None, None] * np.array([[1.0], [-1.0]])
        ends = self._steps(one.by, self.layout.moved(one.clear, changes * directions[:, None]))
        return self.layout.difference(ends, middle) / changes

    def _between(self, one: _Row, starts: Float[np.ndarray, "columns 2 size"], widths: np.ndarray) -> np.ndarray:
        ends = self._steps(one.by, starts)
        return self.layout.difference(ends[:, 0], ends[:, 1]) / widths[:, None]

    def _off_stages(self, one: _Row, change: Float[np.ndarray, " nv"]) -> np.ndarray:
        """Return a state near which no stage of Runge-Kutta meets a surface: there differences of any width are alike."""
        # Accelerations move the stages, so that their places are not known beforehand.
        row, layout = one.clear, self.layout
        for _ in range(4):
            sizes = np.array([1.0, 4.0])
            starts = layout.moved(row, (sizes[:, None] * np.array([1.0, -1.0]))[..., None] * change)
            near, far = self._between(one, starts, 2 * sizes)
            if np.linalg.norm(near - far) <= 0.1 * np.linalg.norm(far):
                break
            row = layout.moved(row, 8 * change)
        return row

    def _steepness(self, matrix: Float[np.ndarray, "... size columns"]) -> Float[np.ndarray, "... nv"]:
        """Return the largest change of a velocity with each position, both of the farthest points that they move (1/s)."""
        lengths = self.surfaces.lengths
        nv = len(lengths)
        return np.abs(matrix[..., nv : 2 * nv, :nv] * lengths[:, None] / lengths).max(axis=-2, initial=0.0)

    def _is_steep(self, matrix: Float[np.ndarray, "... size size"]) -> bool:
        """Return whether differences are steeper than any contact, so that they step over a jump."""
        return not (self._steepness(matrix) <= _STEEP / self.model.opt.timestep).all()

    @np.errstate(invalid="ignore", over="ignore", divide="ignore")
    def sense(self, steps: Steps, index: list[int]) -> None:
        """Write the readings of sensors in states, or their derivatives by "state" and all else that is wanted."""
        for i in index:
            model = id(steps.models[i])
            self._use(steps.models[i], steps.speeds[model], "discrete")
            self.rates = steps.rates[model]
            row, found = steps.rows[i], {name: value[i] for name, value in steps.found.items()}
            if not np.isfinite(row).all():
                continue
            if "readings" in found:
                found["readings"][:] = self._read(row)
            else:
                self._by_sensors(row, found)

    def _read(self, row: np.ndarray, done: int = _NONE) -> Float[np.ndarray, " sensors"]:
        """Return the readings in a state; `done` says which stages are those of the last state that was read."""
        model, data = self.inverse.model, self.inverse.data
        mujoco.mj_setState(model, data, row, EVERY)
        if self.sensed == _PLACES:
            for stage in self.placed:
                stage(model, data)
        elif self.sensed == _SPEEDS:
            for stage in _MOVED if done == _NONE else _MOVED[2:]:
                stage(model, data)
        else:
            mujoco.mj_forwardSkip(model, data, done, False)
        return data.sensordata.copy()

    def _by_sensors(self, row: np.ndarray, found: _Found) -> None:
        """Write small differences of sensors by state, controls, other inputs and numbers."""
        # `mjd_transitionFD` of MuJoCo 3.17, centred, gives those by controls the wrong sign.
        model, layout, place = self.inverse.model, self.layout, self.layout.places["ctrl"]
        middle = self._read(row)
        # What needs fewer stages comes first, while those of the row are known.
        for column in range(model.nu if "ctrl" in found and self.sensed is None else 0):
            own, ends = slice(column, column + 1), []
            up, down, width = self.inverse.sides(row[place][own], WIDTH, own)
            for value in (up, down):
                moved = row.copy()
                moved[place][own] = value
                ends.append(self._read(moved, _SPEEDS))
            found["ctrl"][:, column] = (ends[0] - ends[1]) / width
        is_plain = layout.num_changes == 2 * model.nv + model.na  # without histories of delays
        num_felt = {_PLACES: model.nv, _SPEEDS: 2 * model.nv, None: layout.num_changes}[self.sensed]
        changes = WIDTH * np.array([1.0, -1.0])[:, None] * np.eye(num_felt, layout.num_changes)[:, None]
        starts = layout.moved(row, changes)
        for column in [*range(model.nv, num_felt), *range(model.nv)]:
            done = _PLACES if is_plain and column >= model.nv else _NONE
            above, below = (self._read(start, done) for start in starts[column])
            found["state"][:, column] = (above - below) / (2 * WIDTH)
        for name in (one for one in found if is_other(one)):
            for column, (put, size, is_zero) in enumerate(self._changes(self.inverse, row, name)):
                read = lambda amount, put=put: self._read(put(amount))  # noqa: E731
                found[name][:, column] = _derivative(read, middle, size, is_zero)
                put(0.0)

    def _by_others(self, one: _Row, names: list[str]) -> None:
        """Write differences by inputs beside controls and by numbers of the model; what moves gaps has its share of events."""
        for name in names:
            events = one.events if moves_gaps(name) else None
            shares = np.zeros((0 if events is None else len(events.widths), one.found[name].shape[1]))
            by_solution = one.is_explicit and name != _OF_TIME

            def end(start: np.ndarray, by_solution: bool = by_solution) -> np.ndarray:
                if by_solution:
                    return np.concatenate(one.by.at(start, one.acceleration))
                return self.layout.difference(self._step(one.by, start), one.after)

            middle = end(one.clear)
            for column, (put, size, is_zero) in enumerate(self._changes(one.by, one.clear, name)):
                shift = np.zeros(self.layout.nv)
                if events is not None:
                    shares[:, column] = self._rates(put, size, events)
                    shift = -events.moves @ shares[:, column]

                def at(
                    amount: float, put: Callable = put, shift: np.ndarray = shift, end: Callable = end
                ) -> np.ndarray:
                    start = put(amount)
                    return end(self.layout.moved(start, amount * shift) if shift.any() else start)

                change = _derivative(at, middle, size, is_zero)
                put(0.0)
                if by_solution:
                    one.raw[name][column], one.raw[f"next {name}"][column] = np.split(change, [self.layout.nv])
                    one.raw[f"shift {name}"][column] = shift
                else:
                    one.found[name][:, column] = change
            if one.begun is not None and events is not None:
                one.begun.by_others[name] = shares

    def _changes(
        self, by: Inverse, row: np.ndarray, name: str
    ) -> Iterator[tuple[Callable[[float], np.ndarray], float, bool]]:
        """Give for each entry a function of an amount to the state that it changes so, a small amount, and whether it is zero."""
        # Numbers of the model change here and where gaps are measured.
        if name in INPUTS:
            place, size = self.layout.places[name], min(WIDTH, HAIR) if moves_gaps(name) else WIDTH
            for entry in range(place.start, place.stop):
                yield lambda amount, entry=entry: row + amount * np.eye(1, len(row), entry)[0], size, False
            return
        models = by.model, self.surfaces.model
        if name == PARAMETERS:
            yield from self._by_parameters(models, row)
            return
        parts = [_Numbers.of(model, name) for model in models]
        for entry, (value, size) in enumerate(zip(parts[0].values.tolist(), parts[0].sizes.tolist(), strict=True)):
            put = functools.partial(_moved, row, [(part, np.array([entry]), np.ones(1)) for part in parts])
            yield put, 10 * WIDTH * size or WIDTH, value == 0.0

    def _by_parameters(
        self, models: tuple[mujoco.MjModel, ...], row: np.ndarray
    ) -> Iterator[tuple[Callable[[float], np.ndarray], float, bool]]:
        """Give the same for each parameter, which moves several entries of several arrays at once."""
        every = [(rates, [_Numbers.of(model, name) for model in models]) for name, rates in self.rates.items()]
        every = [(rates, parts) for rates, parts in every if parts[0].values.size]  # the others are MJX's own
        for column in range(next(iter(self.rates.values())).shape[-1]):
            moved, sizes, is_zero = [], [], True
            for each, parts in every:
                rates = each.reshape(parts[0].values.size, -1)[:, column]
                if (entries := np.flatnonzero(rates)).size:
                    moved += [(part, entries, rates[entries]) for part in parts]
                    length = np.linalg.norm(parts[0].sizes[entries])
                    sizes.append((10 * WIDTH * length or WIDTH) / np.linalg.norm(rates[entries]))
                    is_zero &= not length
            yield functools.partial(_moved, row, moved), min(sizes, default=WIDTH), is_zero

    def _rates(self, put: Callable[[float], np.ndarray], size: float, events: Events) -> Float[np.ndarray, " modes"]:
        """Return by how much the modes of events change with what is put."""
        found = []
        for amount in (0.0, size, -size):
            mujoco.mj_setState(self.surfaces.model, self.far, put(amount), EVERY)
            found.append((amount, *self.surfaces.gaps(self.far)))
        alike = [(amount, gaps) for amount, owners, gaps in found if owners == found[0][1]]
        (first, before), (last, after) = alike[-2:] if len(alike) > 1 else 2 * alike
        change = (after - before) / (last - first if last != first else 1.0)
        return events.weights @ change[events.index]

    def _steps(self, by: Inverse, starts: Float[np.ndarray, "... size"]) -> np.ndarray:
        rows = starts.reshape(-1, starts.shape[-1])
        return self.stepper(rows, [by.model] * len(rows)).reshape(starts.shape)

    def _step(self, by: Inverse, row: np.ndarray) -> np.ndarray:
        mujoco.mj_setState(by.model, by.data, row, EVERY)
        mujoco.mj_step(by.model, by.data)
        mujoco.mj_getState(by.model, by.data, end := np.empty_like(row), EVERY)
        return end


def _sensed(model: mujoco.MjModel) -> int | None:
    """Return the stage after which all sensors can be read, where that is not the last: no solver is needed for places."""
    # A function of the user's may read anything; energies are no sensor's own affair.
    others = [getattr(mujoco.mjtSensor, f"mjSENS_{name}") for name in ("USER", "PLUGIN", "E_POTENTIAL", "E_KINETIC")]
    if np.isin(model.sensor_type, others).any() or model.nhistory or model.nplugin or not model.nsensor:
        return None
    stage = model.sensor_needstage.max()
    return int(stage) if stage in (_PLACES, _SPEEDS) else None


def _are_frames(model: mujoco.MjModel) -> bool:
    """Return whether all sensors read joints or frames of bodies, geoms and sites, for which kinematics are enough."""
    names = ("JOINTPOS", "BALLQUAT", "FRAMEPOS", "FRAMEQUAT", "FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS")
    frames = [getattr(mujoco.mjtSensor, f"mjSENS_{name}") for name in names]
    has_cameras = mujoco.mjtObj.mjOBJ_CAMERA in (*model.sensor_objtype, *model.sensor_reftype)
    return bool(np.isin(model.sensor_type, frames).all()) and not has_cameras


def _derivative(end: Callable[[float], np.ndarray], middle: np.ndarray, size: float, is_zero: bool) -> np.ndarray:
    """Return the derivative by an amount. A number that is zero may be a switch, which no small amount may turn on."""

    def to(amount: float) -> np.ndarray | None:
        try:
            return (end(amount) - middle) / amount
        except mujoco.FatalError:  # not a model that MuJoCo steps
            return None

    up, down = to(size), to(-size)
    if is_zero:
        if up is None or (down is not None and _differ(up, down, _KINK)):
            # A side counts if half of the amount does half as much: its own first, and at a surface the other one.
            sides = [x for x, sign in ((up, 1), (down, -1)) if x is not None and _is_linear(x, to(sign * size / 2))]
            return sides[0] if sides else 0.0 * middle
        return up if down is None else 0.5 * (up + down)
    if up is None or down is None:
        return 0.0 * middle
    apart = np.linalg.norm(up - down)
    if apart * size > _ROUNDING and _differ(up, down, _BEND):
        # A contact begins or ends in between, or a foot starts to slip: narrower differences step over neither.
        for width in (_NARROWER * size, _NARROWER**2 * size):
            one, other = to(width), to(-width)
            if one is None or other is None:
                break
            if not _differ(one, other, _BEND):
                return 0.5 * (one + other)
            if np.linalg.norm(one - other) > 0.5 / _NARROWER * apart:  # a jump, however narrow the difference
                return min(one, other, key=np.linalg.norm)
    return 0.5 * (up + down)


def _differ(one: np.ndarray, other: np.ndarray, share: float) -> bool:
    return bool(np.linalg.norm(one - other) > share * max(np.linalg.norm(one), np.linalg.norm(other)))


def _is_linear(whole: np.ndarray, half: np.ndarray | None) -> bool:
    return half is not None and bool(np.linalg.norm(half - whole) <= _KINK * np.linalg.norm(whole))


@dataclass(frozen=True)
class _Numbers:
    """Numbers of a model: who has them, by which name, and what they are."""

    holder: Any
    name: str
    values: Float[np.ndarray, " entries"]
    sizes: Float[np.ndarray, " entries"]  # their own, or of their row where that is rounding beside it

    @classmethod
    def of(cls, model: mujoco.MjModel, field: str) -> "_Numbers":
        holder, name = model.opt if field.startswith("opt.") else model, field.removeprefix("opt.")
        values = np.array(getattr(holder, name, []), float)
        sizes = np.abs(values)
        if values.ndim > 1:
            row = np.linalg.norm(values, axis=-1, keepdims=True)
            sizes = np.where((sizes > 0) & (sizes < _BESIDE_ROW * row), row, sizes)
        if field.endswith(_SHAPES):
            sizes = np.where(sizes > 0, np.maximum(sizes, _SHORT), sizes)
        return cls(holder, name, values.reshape(-1), sizes.reshape(-1))

    def move(self, entries: Int[np.ndarray, " some"], change: Float[np.ndarray, " some"]) -> None:
        """Change some of them from what they were."""
        present = getattr(self.holder, self.name)
        if isinstance(present, float):
            setattr(self.holder, self.name, self.values.item() + change.item())
        else:
            present.reshape(-1)[entries] = self.values[entries] + change


def _moved(row: np.ndarray, moved: list[tuple[_Numbers, np.ndarray, np.ndarray]], amount: float) -> np.ndarray:
    """Change numbers of models from what they were, at their rates; the state is as it was."""
    for numbers, entries, rates in moved:
        numbers.move(entries, amount * rates)
    return row


def with_pairs(wanted: tuple[str, ...]) -> tuple[str, ...]:
    """Return what is wanted with what tells of pairs: by the state, and what they feel of all that moves gaps."""
    return (*wanted, *PAIRS, *FIRST, *(f"felt {name}" for name in wanted if moves_gaps(name)))


def moves_gaps(name: str) -> bool:
    """Return whether an array of the model or an input moves surfaces; parameters may."""
    return name.endswith(_SHAPES) or name == PARAMETERS


def is_other(name: str) -> bool:
    """Return whether a derivative is by an input beside controls or by numbers of the model."""
    return " " not in name and name not in {"state", "ctrl", *PAIRS, *FIRST}
