"""C MuJoCo on all cores: batches of rollouts, and the Jacobians of their steps by differences."""

import copy
import dataclasses
import functools
import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from mjxgrad._warnings import collected
from mjxgrad.native.events import HAIR, Events, Near, Surfaces, clearance, levers_of, undecided
from mjxgrad.native.pairs import End, Pair, num_slots, settle
from mjxgrad.scene.scene import with_numbers
from mjxgrad.stepping import Gradient

INPUTS = ("ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat")
"""What may be given to each step, in the order in which MuJoCo keeps it."""
START = ("time", "qpos", "qvel", "act")
PAIRS = ("felt", "slot", "apart", "stays")
"""Of a slope over several steps. Of each pair of motions that begins: what it feels of a change, and which slot it gets. Of each
slot: how far apart its pair is after the step, and whether it goes on.

See `native.pairs`. As "felt geom_size" by an input or number that moves gaps.
"""
_STATE = mujoco.mjtState
_USER = _STATE.mjSTATE_USER.value & ~_STATE.mjSTATE_USERDATA.value
_MOTION = _STATE.mjSTATE_QPOS.value | _STATE.mjSTATE_QVEL.value | _STATE.mjSTATE_ACT.value
_FULL, _ALL = _STATE.mjSTATE_FULLPHYSICS.value, _STATE.mjSTATE_INTEGRATION.value
_NUM_THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_WIDTH = 1e-6  # of small differences, as MuJoCo's own documentation has it; of parameters as a share of their value
# How the names of model arrays and inputs end that move surfaces.
_SHAPES = ("size", "pos", "quat", "axis", "range", "margin", "gap", "qpos0", "vert", "data")
_RUBBING = 1e-3  # m/s or rad/s, of differences by velocities, and by what is no position, where edges or corners touch
_NOTHING = 1e-9  # of a displacement by one
# Over a time step. A contact of two steps, the shortest, is as steep as 1/4: steeper differences step over a jump.
_STEEP, _NARROWER = 10.0, 1 / 30
_STEPS = 10  # over which a difference of velocities is one of positions
_TOLERANCE, _ITERATIONS = 1e-16, 200  # of the steps that are subtracted: what a solve leaves is divided by the width

_Arrays = Mapping[str, np.ndarray]


@functools.lru_cache(maxsize=8)
def engine_of(mj_model: mujoco.MjModel) -> "Engine":
    """Return the engine of a C model; threads and memory are kept, and programs that call it are compiled once."""
    return Engine(mj_model)


class Engine:
    """A pool of threads for one C model. Arrays have the batch's axes in front, of length one where they are shared."""

    def __init__(self, mj_model: mujoco.MjModel):
        self.mj_model, self.lock = mj_model, threading.Lock()
        self.pool, self.threads = mujoco.rollout.Rollout(nthread=_NUM_THREADS), ThreadPoolExecutor(_NUM_THREADS)
        self.start = mujoco.MjData(mj_model)
        self.plain = copy.deepcopy(mj_model)
        # A state that is not finite stays so, and is seen.
        self.plain.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.kept = ({}, self.plain)  # the last numbers that all of a batch shared, and their model
        self.levers = levers_of(mj_model)
        bits = {name: getattr(_STATE, f"mjSTATE_{name.upper()}").value for name in (*START, "warmstart", *INPUTS)}
        begins = {name: mujoco.mj_stateSize(mj_model, _ALL & (bit - 1)) for name, bit in bits.items()}
        self.places = {
            name: slice(begins[name], begins[name] + mujoco.mj_stateSize(mj_model, bit)) for name, bit in bits.items()
        }
        self.workers = [_Worker(self) for _ in range(_NUM_THREADS)]

    def run(self, numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> dict[str, np.ndarray]:
        """Return positions, velocities and activations after each step."""
        with self.lock, collected():
            batch, models, start, inputs = self._flat(np.ndim(start["time"]) - 1, numbers, start, inputs)
            rows = self._rows(start)
            full = np.zeros((len(rows), mujoco.mj_stateSize(self.mj_model, _FULL)))
            for row, part in zip(rows, full, strict=True):
                mujoco.mj_extractState(self.mj_model, row, _ALL, part, _FULL)
            user = rows[:, self.places["ctrl"].start : self.places["mocap_quat"].stop]
            given = np.repeat(user[:, None], inputs["ctrl"].shape[1], axis=1)
            for name, value in inputs.items():
                place = self.places[name].start - self.places["ctrl"].start
                width = math.prod(value.shape[2:])
                given[..., place : place + width] = value.reshape(*value.shape[:2], width)
            found = self.pool.rollout(models, [one.data for one in self.workers], full, given, control_spec=_USER)[0]
        parts = {name: np.asarray(found)[..., self.places[name]] for name in START[1:]}
        return {name: part.reshape(*batch, *part.shape[1:]) for name, part in parts.items()}

    def steer(
        self, num_substeps: int, dtype: np.dtype, numbers: _Arrays, start: _Arrays, law: _Arrays
    ) -> dict[str, np.ndarray]:
        """Return states and controls under a law: controls that a gain corrects by the distance from nominal states, in limits.

        A control is rounded to a type, so that a rollout of it is the same motion, and is held for some time steps.
        """
        with self.lock, collected():
            batch, models, start, law = self._flat(np.ndim(start["time"]) - 1, numbers, start, law)
            nq, nv = self.mj_model.nq, self.mj_model.nv
            found = {"states": np.zeros(law["states"].shape), "controls": np.zeros(law["controls"].shape, dtype)}
            columns = (*(law[name] for name in ("states", "controls", "gain")), *found.values())
            rows = self._rows(start)

            @np.errstate(invalid="ignore", over="ignore")
            def work(one: _Worker, piece: list[int]) -> None:
                away, ctrl = np.zeros(law["gain"].shape[3]), one.data.ctrl
                for i in piece:
                    state = law["states"][i, 0]
                    follows, lower, upper = (law[name][i] for name in ("follows", "lower", "upper"))
                    mujoco.mj_setState(models[i], one.data, rows[i], _ALL)
                    mujoco.mj_setState(models[i], one.data, state, _MOTION)
                    for nominal, control, gain, end, chosen in zip(*(x[i] for x in columns), strict=True):
                        if follows:
                            mujoco.mj_differentiatePos(models[i], away[:nv], 1.0, nominal[:nq], state[:nq])
                            np.subtract(state[nq:], nominal[nq:], out=away[nv:])
                            control = control + gain @ away
                        np.minimum(np.maximum(control, lower), upper, out=chosen)
                        ctrl[:] = chosen
                        mujoco.mj_step(models[i], one.data, num_substeps)
                        mujoco.mj_getState(models[i], one.data, end, _MOTION)
                        state = end

            self._share(work, len(models))
        return {name: value.reshape(*batch, *value.shape[1:]) for name, value in found.items()}

    def linearise(
        self, numbers: _Arrays, start: _Arrays, inputs: _Arrays, *,
        gradient: Gradient, wanted: tuple[str, ...], num_substeps: int = 1, is_centred: bool = True,
    ) -> dict[str, np.ndarray]:  # fmt: skip
        """Return the Jacobians of single steps in tangent space, by "state" and by each input and number that is wanted.

        Those of the sensors, "C" and "D", are of small differences with either gradient.

        States before each step are in `start`, with an axis of steps as inputs have it. A step may be several of MuJoCo's;
        "end" is the state after it, NaN if it is not finite. Away from surfaces differences may be to one side.
        """
        with self.lock, collected():
            batch, models, start, inputs = self._flat(np.ndim(start["time"]) - 2, numbers, start, inputs)
            steps = inputs["ctrl"].shape[1]
            rows = self._rows({k: v.reshape(len(models) * steps, *v.shape[2:]) for k, v in {**start, **inputs}.items()})
            sizes = {k: math.prod(v.shape[2:]) for k, v in inputs.items()}
            sizes |= {k: math.prod(np.shape(v)[len(batch) :]) for k, v in numbers.items()}
            kept = with_pairs(wanted) if gradient == "slope" and num_substeps > 1 else wanted
            shapes, size = self.shapes(kept, sizes).items(), (num_substeps, len(rows))
            found = {k: np.full((*size, *shape), np.nan if k == "end" else 0.0) for k, shape in shapes}
            speeds = start["qvel"] if num_substeps == 1 else self._reached(start["qvel"], num_substeps)
            for one in self.workers:
                one.begin(gradient, is_centred)
            courses = _Courses(steps, rows, np.full((*size, rows.shape[1]), np.nan))
            self._share(lambda one, piece: one.fill(models, speeds, courses, piece, found), len(rows))
            if courses.pairs and "apart" in found:
                by_course = {k: courses.of(v) for k, v in found.items() if k.split()[0] in ("state", *PAIRS)}
                pairs = [one for begun in courses.pairs.values() for one in begun]
                self._share(
                    lambda one, piece: one.pursue(courses, [pairs[k] for k in piece], by_course["state"]), len(pairs)
                )
                settle(pairs, by_course)
        total = {name: value[-1 if name == "end" else 0] for name, value in found.items()}
        if num_substeps > 1:
            total |= _through(found, ["state", *(name for name in wanted if name != "end")])
        return {name: total[name].reshape(*batch, steps, *total[name].shape[1:]) for name in ("state", *wanted)}

    def follow(
        self,
        gradient: Gradient,
        numbers: _Arrays,
        start: _Arrays,
        inputs: _Arrays,
        changes: tuple[np.ndarray, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return a course as `run` does and, as "change", what becomes of a change of the start and of the controls.

        Changes are in tangent space; along one direction a step takes two differences in place of one for each coordinate.
        """
        with self.lock, collected():
            _, models, start, inputs = self._flat(np.ndim(start["time"]) - 1, numbers, start, inputs)
            num_steps, model = inputs["ctrl"].shape[1], self.mj_model
            sizes = {"qpos": model.nq, "qvel": model.nv, "act": model.na, "change": 2 * model.nv + model.na}
            found = {name: np.zeros((len(models), num_steps, size)) for name, size in sizes.items()}
            first = self._rows({**start, **{name: value[:, 0] for name, value in inputs.items()}})
            speeds = self._reached(start["qvel"], num_steps)

            def work(one: _Worker, piece: list[int]) -> None:
                one.begin(gradient)
                for i in piece:
                    one.use(models, i, speeds)
                    course = ({k: v[i] for k, v in inputs.items()}, changes[0][i], changes[1][i])
                    one.follow(first[i], *course, {k: v[i] for k, v in found.items()})

            self._share(work, len(models))
        return found

    def shapes(self, wanted: tuple[str, ...], sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the Jacobians of one step: of its end by all that is wanted, and of its sensors, "C" and "D"."""
        model, size = self.mj_model, 2 * self.mj_model.nv + self.mj_model.na
        own = {"C": (model.nsensordata, size), "D": (model.nsensordata, model.nu), "end": (size - model.nv + model.nq,)}
        own |= {
            "felt": (model.nv, size),
            "slot": (model.nv,),
            "apart": (size, num_slots(model)),
            "stays": (num_slots(model),),
        }
        own |= {k: (model.nv if k.startswith("felt") else size, sizes[k.split()[-1]]) for k in wanted if k not in own}
        return {"state": (size, size)} | {k: own[k] for k in wanted}

    def _share(self, work: Callable[["_Worker", list[int]], None], count: int) -> None:
        """Do so many things on all threads; each takes its piece of them."""
        pieces = [piece.tolist() for piece in np.array_split(np.arange(count), min(_NUM_THREADS, count))]
        list(map(work, self.workers, pieces) if len(pieces) == 1 else self.threads.map(work, self.workers, pieces))

    def _reached(self, speeds: np.ndarray, num_steps: int) -> np.ndarray:
        """Return speeds for margins in later steps, which are not known before: twice those of the start, or of a fall."""
        model = self.mj_model
        return np.maximum(2 * np.abs(speeds), num_steps * model.opt.timestep * np.linalg.norm(model.opt.gravity))

    def _flat(self, ndim: int, numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> tuple:
        """Return the batch's shape, one model for each of it or for all, and the arrays with one axis for the batch's."""
        values = {name: np.asarray(value) for name, value in numbers.items()}
        given = [{k: np.asarray(v, float) for k, v in one.items()} for one in (start, inputs)]
        batch = np.broadcast_shapes(*(x.shape[:ndim] for one in (*given, values) for x in one.values()))

        def flat(x: np.ndarray) -> np.ndarray:
            return np.broadcast_to(x, batch + x.shape[ndim:]).reshape(math.prod(batch), *x.shape[ndim:])

        varied = {name: flat(x) for name, x in values.items() if math.prod(x.shape[:ndim]) > 1}
        shared = {k: x.reshape(x.shape[ndim:]) for k, x in values.items() if k not in varied}
        content = {k: x.tobytes() for k, x in shared.items()}
        if content != self.kept[0]:
            self.kept = (content, with_numbers(self.plain, shared))
        base = self.kept[1]
        models = [base] * math.prod(batch)
        if varied:
            models = [with_numbers(base, {name: x[i] for name, x in varied.items()}) for i in range(len(models))]
        return batch, models, *({k: flat(v) for k, v in one.items()} for one in given)

    def _rows(self, start: _Arrays) -> Float[np.ndarray, "rows size"]:
        """Return whole states of MuJoCo, one a row, of which the start is given."""
        template = np.zeros(mujoco.mj_stateSize(self.mj_model, _ALL))
        mujoco.mj_getState(self.mj_model, self.start, template, _ALL)
        rows = np.tile(template, (len(start["time"]), 1))
        for name, value in start.items():
            rows[:, self.places[name]] = value.reshape(len(rows), math.prod(value.shape[1:]))
        return rows


@dataclasses.dataclass
class _Courses:
    """Courses of steps, each over the substeps of a row or over the rows of a trajectory, and the pairs that begin there.

    Attributes:
        num_steps: rows of a trajectory.
        rows: the states that are given.
        states: those before each substep of each row, NaN after one that is not finite.
        pairs: those that begin in a step, by its place.
    """

    num_steps: int
    rows: Float[np.ndarray, "rows size"]
    states: Float[np.ndarray, "substeps rows size"]
    pairs: dict[tuple[int, int], list[Pair]] = dataclasses.field(default_factory=dict)

    def of(self, value: np.ndarray) -> np.ndarray:
        """Return an array of substeps and rows by courses and their steps."""
        return value.swapaxes(0, 1) if len(value) > 1 else value[0].reshape(-1, self.num_steps, *value.shape[2:])

    def place(self, substep: int, row: int) -> tuple[int, int]:
        """Return which step of which course this is."""
        return (row, substep) if len(self.states) > 1 else divmod(row, self.num_steps)


class _Worker:
    """The steps and Jacobians of one thread, which keeps its data and its copy of a model."""

    def __init__(self, engine: Engine):
        self.engine, self.data, self.places = engine, mujoco.MjData(engine.mj_model), engine.places
        self.given = self.model = engine.mj_model  # as given, and as differences take it
        self.gradient = None

    @np.errstate(invalid="ignore", over="ignore")
    def fill(self, models: list, speeds: np.ndarray, courses: _Courses, index: list[int], found: dict) -> None:
        """Write the Jacobians of chosen rows; rows of one trajectory, which share a model, follow each other."""
        for i in index:
            self.use(models, i // courses.num_steps, speeds)
            row = courses.rows[i].copy() if np.isfinite(courses.rows[i]).all() else None
            for t in range(len(courses.states)):
                if row is None:
                    break
                parts = {name: value[t, i] for name, value in found.items()}
                end, pairs = self._one(self.model, row, parts)
                courses.states[t, i] = row
                for one in pairs:
                    one.place = courses.place(t, i)
                    courses.pairs[one.place] = pairs
                row = end

    @np.errstate(invalid="ignore", over="ignore")
    def pursue(
        self, courses: _Courses, pairs: list[Pair], matrices: Float[np.ndarray, "courses steps size size"]
    ) -> None:
        """Follow pairs until the motion's derivative takes over, or their course ends."""
        states = courses.of(courses.states)
        for one in pairs:
            number, first = one.place
            for t in range(first + 1, states.shape[1]):
                if one.is_over or not np.isfinite(states[number, t]).all():
                    break
                change, begun = one.apart[-1], courses.pairs.get((number, t), ())
                expected = matrices[number, t] @ change + sum(other.apart[0] * (other.felt @ change) for other in begun)
                if not self._goes_on(one, states[number, t], expected):
                    break

    def _goes_on(self, pair: Pair, row: np.ndarray, expected: Float[np.ndarray, " size"]) -> bool:
        """Take a step of a pair by the inputs of a state; return whether it is finite."""
        ends = [self._step(pair.model, self._at(row, end)) for end in pair.ends]
        return pair.go_on(ends, _change(pair.model, *ends), expected)

    def begin(self, gradient: Gradient, is_centred: bool = True) -> None:
        """Take a gradient for what follows."""
        if gradient == "slope" or gradient != self.gradient:  # surfaces of states at rest serve all calls
            self.near_to = None
        self.gradient, self.is_centred = gradient, is_centred

    def use(self, models: list, index: int, speeds: Float[np.ndarray, "trajectories *steps nv"]) -> None:
        """Take the model of a trajectory for what follows; it is copied once for all that share it, and move so fast."""
        given = models[index]
        if given is not self.given:
            self.given, self.model = given, copy.deepcopy(given)
            self.model.opt.tolerance, self.model.opt.iterations = _TOLERANCE, max(_ITERATIONS, given.opt.iterations)
        if given is not self.near_to:
            alike, model = [k for k, one in enumerate(models) if one is given], self.model
            reached = speeds[alike].reshape(-1, model.nv)
            self.surfaces = Surfaces(model, self.engine.levers, reached if self.gradient == "slope" else 0 * reached)
            self.near_to, self.far = given, mujoco.MjData(self.surfaces.model)

    @np.errstate(invalid="ignore", over="ignore")
    def follow(self, row: np.ndarray, inputs: dict, change: np.ndarray, pushes: np.ndarray, found: dict) -> None:
        """Write a course, step by step, and what becomes of a change; a state that is no longer finite stays."""
        plain, row, nothing = self.given, row.copy(), np.zeros(pushes.shape[1])
        followed: list[tuple[Pair, float]] = []
        for t, push in enumerate(pushes):
            for name, value in inputs.items():
                row[self.places[name]] = value[t].reshape(-1)
            ends = self._step(plain, row)
            row[self.places["warmstart"]] = self.data.qacc_warmstart
            model, near, pairs, clear = self._near(self.model, row, ends[1])
            for one, _ in followed:
                ahead, felt = self._carried(model, near, pairs, clear, one.apart[-1], nothing)
                ahead += sum(felt * other.apart[0] for other, felt in zip(pairs, felt, strict=True))
                if not self._goes_on(one, row, ahead):
                    one.apart.append(0 * one.apart[-1])
            change, felt = self._carried(model, near, pairs, clear, change, push)
            begun = list(zip(pairs, felt, strict=True))
            followed += begun
            change += sum(felt * one.apart[-1] for one, felt in followed if one.is_over)
            followed = [(one, felt) for one, felt in followed if not one.is_over]
            row[self.places["time"]] += model.opt.timestep
            for name, end in zip(START[1:], ends, strict=True):
                row[self.places[name]] = found[name][t] = end
            found["change"][t] = change + sum(felt * one.apart[-1] for one, felt in followed)

    def _carried(
        self, model: mujoco.MjModel, near: Near | None, pairs: list[Pair], row: np.ndarray, change: np.ndarray,
        push: np.ndarray,
    ) -> tuple[Float[np.ndarray, " size"], list[float]]:  # fmt: skip
        """Return what a step makes of a change and of one of the controls, without events, and what each event feels."""
        nv, rest, moved = model.nv, change.copy(), np.zeros_like(change)
        felt = [(one.felt @ change).item() for one in pairs]
        if near is not None and near.events is not None:
            rest[:nv] -= near.events.moves @ felt
        if near is not None and near.is_rough:
            moved = self._visibly(model, row, rest[:nv], near)
            rest[:nv] = 0.0
        width = self._width(near) / max(np.abs(rest).max(), np.abs(push).max(initial=0.0), 1e-30)
        sides = []
        for side in (width, -width):
            sides.append(self._moved(model, row, side * rest))
            sides[-1][self.places["ctrl"]] += side * push
        return moved + self._difference(model, *sides) / (2 * width), felt

    def _one(
        self, model: mujoco.MjModel, row: np.ndarray, found: dict[str, np.ndarray]
    ) -> tuple[np.ndarray | None, list[Pair]]:
        """Write the Jacobians of a step, and return the state after it where that is finite, and the pairs of its events."""
        end = np.empty_like(row)
        mujoco.mj_setState(model, self.data, row, _ALL)
        mujoco.mj_step(model, self.data)
        mujoco.mj_getState(model, self.data, end, _ALL)
        if not np.isfinite(end).all():
            return None, []
        if "end" in found:
            mujoco.mj_getState(model, self.data, found["end"], _MOTION)
        row[self.places["warmstart"]] = end[self.places["warmstart"]]
        model, near, pairs, clear = self._near(model, row, end[self.places["qvel"]])
        events = None if near is None else near.events
        self._differentiate(model, clear, found, self._width(near), self.is_centred or near is not None)
        self._by_others(model, clear, found, self._width(near), events, pairs)
        if near is None:
            return end, pairs
        matrix, nv, rest = found["state"], model.nv, np.eye(model.nv)
        if events is not None:
            rest -= events.moves @ events.rows
            matrix[:, nv : 2 * nv] -= matrix[:, :nv] @ events.moves @ events.ahead
        if near.is_rough:
            matrix[:, :nv] = np.transpose([self._visibly(model, clear, change, near) for change in rest.T])
        elif events is not None:
            matrix[:, :nv] = matrix[:, :nv] @ rest
        if "apart" not in found:  # nobody follows them
            for one in pairs:
                matrix += np.outer(one.apart[0], one.felt)
        return end, pairs

    def _visibly(
        self, model: mujoco.MjModel, row: np.ndarray, change: np.ndarray, near: Near
    ) -> Float[np.ndarray, " size"]:
        """Return the derivative along a displacement, by as much as moves surfaces visibly."""
        if np.abs(change).max() < _NOTHING:  # what an event leaves of a coordinate that moves it alone
            return np.zeros(2 * model.nv + model.na)
        return self._along(model, row, change, near.width(change))

    def _along(
        self, model: mujoco.MjModel, row: np.ndarray, change: np.ndarray, width: float
    ) -> Float[np.ndarray, " size"]:
        """Return the derivative along a change of the state, by a central difference."""
        ends = [self._moved(model, row, side * width * change) for side in (1, -1)]
        return self._difference(model, *ends) / (2 * width)

    def _width(self, near: Near | None) -> float:
        """Return the width of differences by all but positions: under friction, small ones see what comes of rounding.

        The stages of Runge-Kutta have other positions at other velocities, and would meet surfaces.
        """
        return _WIDTH if near is None or not near.is_rough or self.surfaces.lead else _RUBBING

    def _near(
        self, model: mujoco.MjModel, row: np.ndarray, after: np.ndarray
    ) -> tuple[mujoco.MjModel, Near | None, list[Pair], np.ndarray]:
        """Return the model to take differences of, what is near, its pairs, and the state about which none crosses a surface."""
        near, shift, is_undecided = None, None, False
        if np.isfinite(after).all():
            mujoco.mj_setState(self.surfaces.model, self.far, row, _ALL)
            if self.gradient == "slope":
                near = self.surfaces.near(self.far, row[self.places["qvel"]], after, self.data.qacc_smooth)
                is_undecided = near is not None and near.is_undecided
            else:
                shift, is_undecided = self.surfaces.beside(_WIDTH, self.far)
        if is_undecided:
            model = min(undecided(model), key=lambda one: np.abs(self._step(one, row)[1] - after).max())
        if near is None or near.events is None:
            return model, near, [], row if shift is None else self._moved(model, row, shift)
        pairs = self._begun(model, row, events := near.events)
        if not np.isfinite([one.apart for one in pairs]).all():  # a step from beside this state may end nowhere
            return model, dataclasses.replace(near, events=None), [], row
        clear = self._moved(model, row, clearance(_WIDTH, events.surfaces, events.gaps, events.centres))
        if self.surfaces.lead:
            for move, rates in zip(events.moves.T, events.rows, strict=True):
                clear = self._off_stages(model, clear, _WIDTH * np.abs(rates).max() * move)
        return model, near, pairs, clear

    def _begun(self, model: mujoco.MjModel, row: np.ndarray, events: Events) -> list[Pair]:
        """Return the two motions that span each event, after one step."""
        found, felt = [], np.pad(np.hstack([events.rows, events.ahead]), ((0, 0), (0, model.na)))
        lengths = self.surfaces.lengths
        scale = np.concatenate([lengths, _STEPS * model.opt.timestep * lengths, np.zeros(model.na)])
        for middle, width, move, own in zip(events.middles.T, events.widths, events.moves.T, felt, strict=True):
            ends = [self._step(model, self._moved(model, row, middle + side * width * move)) for side in (1, -1)]
            pair = Pair(model, ends, 2 * width, own, scale, [_change(model, *ends) / (2 * width)])
            pair.longest = 2 if self.surfaces.lead else pair.longest
            found.append(pair)
        return found

    def _off_stages(self, model: mujoco.MjModel, row: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return a state near which no stage of Runge-Kutta meets a surface: there differences of any width are alike.

        Accelerations move the stages, so that their places are not known beforehand.
        """
        for _ in range(4):
            near, far = (self._along(model, row, change, width) for width in (1.0, 4.0))
            if np.linalg.norm(near - far) <= 0.1 * np.linalg.norm(far):
                break
            row = self._moved(model, row, 8 * change)
        return row

    def _at(self, row: np.ndarray, end: End) -> np.ndarray:
        """Return a whole state with position, velocity and activation of another."""
        placed = row.copy()
        for name, value in zip(START[1:], end, strict=True):
            placed[self.places[name]] = value
        return placed

    def _differentiate(
        self, model: mujoco.MjModel, row: np.ndarray, found: dict[str, np.ndarray], width: float, is_centred: bool
    ) -> None:
        """Write differences of this width by all that is wanted; narrower ones, where these step over a jump."""
        self._subtract(model, row, found, width, is_centred)
        if self._steepness(found["state"]) > _STEEP / model.opt.timestep:
            narrow = {name: found[name].copy() for name in ("state", "ctrl", "C", "D") if name in found}
            self._subtract(model, row, narrow, _NARROWER * width, is_centred)
            if self._steepness(narrow["state"]) < 0.5 * self._steepness(found["state"]):
                for name, value in narrow.items():
                    found[name][:] = value

    def _steepness(self, matrix: Float[np.ndarray, "size size"]) -> float:
        """Return the largest change of a velocity with a position, both of the farthest points that they move (1/s)."""
        lengths = self.surfaces.lengths
        nv = len(lengths)
        return np.abs(matrix[nv : 2 * nv, :nv] * lengths[:, None] / lengths).max(initial=0.0)

    def _subtract(
        self, model: mujoco.MjModel, row: np.ndarray, found: dict[str, np.ndarray], width: float, is_centred: bool
    ) -> None:
        """Write differences of this width by state, controls and, of sensors, both."""
        nu, is_refused = model.nu, model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        by_control = found["ctrl"] if "ctrl" in found else np.zeros((len(found["state"]), nu))
        if is_refused:  # by MuJoCo's own function
            for column, change in enumerate(np.eye(len(found["state"]))):
                found["state"][:, column] = self._along(model, row, change, width)
                if "C" in found:
                    found["C"][:, column] = self.sensed / (2 * width)
        else:
            mujoco.mj_setState(model, self.data, row, _ALL)
            sensors = (found.get("C"), found.get("D"))
            mujoco.mjd_transitionFD(model, self.data, width, is_centred, found["state"], by_control, *sensors)
        if is_refused and "ctrl" in found:
            for column in range(nu):
                change = width * (np.arange(len(row)) == self.places["ctrl"].start + column)
                by_control[:, column] = self._difference(model, row + change, row - change) / (2 * width)
                if "D" in found:
                    found["D"][:, column] = self.sensed / (2 * width)

    def _by_others(
        self, model: mujoco.MjModel, row: np.ndarray, found: dict[str, np.ndarray], width: float, events: Events | None,
        pairs: list[Pair],
    ) -> None:  # fmt: skip
        """Write differences by inputs beside controls and by numbers of the model; what moves gaps has its share of events."""
        for name in (one for one in found if " " not in one and one not in {"state", "ctrl", "C", "D", "end", *PAIRS}):
            asked = events if _moves_gaps(name) else None
            changes = self._inputs(row, name, width) if name in INPUTS else self._numbers(model, row, name)
            shares = np.zeros((len(pairs), found[name].shape[1]))
            for column, (put, size) in enumerate(changes):
                shift = np.zeros(model.nv)
                if asked is not None:
                    shares[:, column] = self._rates(put, size, asked)
                    shift = asked.moves @ shares[:, column]
                ends = [self._step(model, self._moved(model, put(x), -x * shift)) for x in (size, -size)]
                put(0.0)
                found[name][:, column] = _change(model, *ends) / (2 * size)
            for one, share in zip(pairs, shares, strict=True):
                if f"felt {name}" in found:
                    one.by_others[name] = share
                elif asked is not None:
                    found[name] += np.outer(one.apart[0], share)

    def _inputs(
        self, row: np.ndarray, name: str, width: float
    ) -> Iterator[tuple[Callable[[float], np.ndarray], float]]:
        """Give for each entry of an input a function of an amount to the state that it changes so, and a small amount."""
        place, size = self.places[name], min(width, HAIR) if _moves_gaps(name) else width
        for entry in range(place.start, place.stop):
            yield functools.partial(_with_entry, row, entry), size

    def _numbers(
        self, model: mujoco.MjModel, row: np.ndarray, name: str
    ) -> Iterator[tuple[Callable[[float], np.ndarray], float]]:
        """Give the same for each entry of an array of the model, which changes here and where gaps are measured."""
        attribute, both = name.removeprefix("opt."), (model, self.surfaces.model)
        holders = [one.opt for one in both] if name.startswith("opt.") else both
        present = [np.array(getattr(one, attribute, []), float).reshape(-1) for one in holders]
        for entry, values in enumerate(np.transpose(present).tolist()):
            change = functools.partial(_with_number, row, holders, attribute, entry, values)
            yield change, 10 * _WIDTH * abs(values[0]) or _WIDTH

    def _rates(self, put: Callable[[float], np.ndarray], size: float, events: Events) -> Float[np.ndarray, " modes"]:
        """Return by how much the modes of events change with what is put."""
        found = []
        for amount in (0.0, size, -size):
            mujoco.mj_setState(self.surfaces.model, self.far, put(amount), _ALL)
            found.append((amount, *self.surfaces.gaps(self.far)))
        alike = [(amount, gaps) for amount, owners, gaps in found if owners == found[0][1]]
        (first, before), (last, after) = alike[-2:] if len(alike) > 1 else 2 * alike
        change = (after - before) / (last - first if last != first else 1.0)
        return events.weights @ change[events.index]

    def _step(self, model: mujoco.MjModel, row: np.ndarray) -> list[np.ndarray]:
        mujoco.mj_setState(model, self.data, row, _ALL)
        mujoco.mj_step(model, self.data)
        return [self.data.qpos.copy(), self.data.qvel.copy(), self.data.act.copy()]

    def _difference(self, model: mujoco.MjModel, above: np.ndarray, below: np.ndarray) -> Float[np.ndarray, " size"]:
        """Return the change of the end of a step, and keep that of its sensors."""
        ends = []
        for row in (above, below):
            ends.append([*self._step(model, row), self.data.sensordata.copy()])
        self.sensed = ends[0][3] - ends[1][3]
        return _change(model, *ends)

    def _moved(self, model: mujoco.MjModel, row: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return a state moved in tangent space: by its position, or by position, velocity and activation."""
        moved, nv = row.copy(), model.nv
        mujoco.mj_integratePos(model, moved[self.places["qpos"]], change[:nv], 1.0)
        if len(change) > nv:
            moved[self.places["qvel"]] += change[nv : 2 * nv]
            moved[self.places["act"]] += change[2 * nv :]
        return moved


def _with_entry(row: np.ndarray, entry: int, amount: float) -> np.ndarray:
    """Return a state with an entry changed by an amount."""
    row = row.copy()
    row[entry] += amount
    return row


def _with_number(
    row: np.ndarray, models: Iterable, attribute: str, entry: int, values: list[float], amount: float
) -> np.ndarray:
    """Change a number of models to their values and an amount; the state is as it was."""
    for model, value in zip(models, values, strict=True):
        present = getattr(model, attribute)
        if isinstance(present, float):
            setattr(model, attribute, value + amount)
        else:
            present.reshape(-1)[entry] = value + amount
    return row


def with_pairs(wanted: tuple[str, ...]) -> tuple[str, ...]:
    """Return what is wanted with what tells of pairs: by the state, and what they feel of all that moves gaps."""
    return (*wanted, *PAIRS, *(f"felt {name}" for name in wanted if _moves_gaps(name)))


def _moves_gaps(name: str) -> bool:
    return name.endswith(_SHAPES)


def _change(model: mujoco.MjModel, above: list[np.ndarray], below: list[np.ndarray]) -> Float[np.ndarray, " size"]:
    """Return one state less another in tangent space."""
    positions = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, positions, 1.0, below[0], above[0])
    return np.concatenate([positions, above[1] - below[1], above[2] - below[2]])


def _through(found: dict[str, np.ndarray], names: list[str]) -> dict[str, np.ndarray]:
    """Return Jacobians of several steps, one after the other; the first is by the state."""
    size, sizes = found["state"].shape[-2], [found[name].shape[-1] for name in names]

    def beside(kind: str, rows: int) -> np.ndarray:
        """Return what is added to each step by all but the state, which has no columns of its own here."""
        shape = (*found["state"].shape[:-2], rows)
        own = [found.get(f"{kind}{k}", np.zeros((*shape, n))) for k, n in zip(names, sizes, strict=True)]
        return np.concatenate([np.zeros((*shape, size)), *own[1:]], axis=-1)

    own, kept = beside("", size), 0.0
    felt = beside("felt ", found["felt"].shape[-2]) if "felt" in found else None
    end = main = np.broadcast_to(np.eye(size, sum(sizes)), (*found["state"].shape[1:-1], sum(sizes)))
    for t, matrix in enumerate(found["state"]):
        end = matrix @ main + own[t]
        if felt is not None:
            is_own = found["slot"][t][..., None, :] == np.arange(found["stays"].shape[-1])[:, None]
            held = is_own @ (found["felt"][t] @ main + felt[t]) + kept
            kept = found["stays"][t][..., None] * held
            end = end + found["apart"][t] @ held
            main = end - found["apart"][t] @ kept
        else:
            main = end
    return dict(zip(names, np.split(end, np.cumsum(sizes)[:-1], axis=-1), strict=True))
