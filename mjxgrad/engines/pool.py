"""C MuJoCo on all cores: batches of rollouts, and the derivatives of their steps."""

import functools
import itertools
import math
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from jaxtyping import Float

from mjxgrad._warnings import collected
from mjxgrad.engines.events import levers_of
from mjxgrad.engines.flight import FIRST, NUM_SLOTS, PAIRS, Course, Flight, advance, fly
from mjxgrad.engines.jacobians import APART, WIDTH, Steps, Worker, solved, with_pairs
from mjxgrad.engines.layout import EVERY, MOTION, USER, Layout
from mjxgrad.engines.multiplied import SlopeWarning, multiplied
from mjxgrad.engines.processes import are_possible, are_started, processes
from mjxgrad.engines.steps import Stepper
from mjxgrad.scene.numbers import PARAMETERS, with_numbers
from mjxgrad.stepping import slope

ONCE = (*FIRST, "flight")
"""What is found of a whole motion, not of each of its steps."""
_NUM_THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_NUMBERS = itertools.count()  # of pools
# Other processes take derivatives of so many steps and more, if they take so long (s) here. Their start takes half a second.
_FEWEST, _SHORT, _LONG = 32, 0.05, 2.0
_MANY = 512  # readings whose derivatives are worth several processes that there are
_RATES = f"{PARAMETERS}:"
_MOST_NUMBERS = 2e7  # of derivatives that are held at a time, where they are not asked for

_Arrays = Mapping[str, np.ndarray]


@functools.lru_cache(maxsize=8)
def pool_of(mj_model: mujoco.MjModel) -> "Pool":
    """Return the pool of a C model; threads and memory are kept, and programs that call it are compiled once."""
    return Pool(mj_model)


class Pool:
    """A pool of threads for one C model. Arrays have the batch's axes in front, of length one where they are shared."""

    def __init__(self, mj_model: mujoco.MjModel, *, num_threads: int = _NUM_THREADS):
        self.mj_model, self.lock, self.number = mj_model, threading.Lock(), next(_NUMBERS)
        self.num_threads, self.threads = num_threads, ThreadPoolExecutor(num_threads)
        self.start, self.layout = mujoco.MjData(mj_model), Layout(mj_model)
        self.steps = Stepper(mj_model, self.layout, num_threads)
        self.places = self.layout.places
        self.plain = with_numbers(mj_model, {})
        # A state that is not finite stays so, and is seen.
        self.plain.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.kept = ({}, self.plain)  # the last numbers that all of a batch shared, and their model
        self.exact = (self.plain, solved(self.plain))  # the last of these models, and as it is differentiated
        levers = levers_of(mj_model)
        self.lengths = levers.max(axis=0)
        self.workers = [Worker(self.layout, levers) for _ in range(num_threads)]
        self.may_share = mj_model.nplugin == 0  # another process may not have its library
        self.looks, self.has_warned = 0, False  # batches of slopes, and whether one multiplied
        self.pace, self.spent = 0.0, 0.0  # seconds of a step's derivatives, and of all that were taken
        self.poses = np.concatenate([mj_model.key_qpos, mj_model.qpos0[None]])
        self.template = np.zeros(self.layout.size)
        mujoco.mj_getState(mj_model, self.start, self.template, EVERY)
        self.first = {name: self.template[self.places[name]] for name in MOTION}

    def run(self, numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> dict[str, np.ndarray]:
        """Return positions, velocities, activations and what else goes on, after each step."""
        # With a warm start, "warmstart" is that of the next step after a single one, so that steps one by one are the
        # same motion to the last bit; after several it is zero.
        with self.lock, collected():
            batch, numbers, start, inputs = self._flat(np.ndim(start["time"]) - 1, numbers, start, inputs)
            models = self._models(numbers, len(start["time"]))
            rows = self._rows(start)
            if "warmstart" in start and inputs["ctrl"].shape[1] == 1:
                found = self._run_once(models, rows, inputs)
            else:
                found = self._run(models, rows, inputs)
                found |= {"warmstart": np.zeros_like(start["warmstart"])} if "warmstart" in start else {}
        return {name: part.reshape(*batch, *part.shape[1:]) for name, part in found.items()}

    def _run_once(self, models: list[mujoco.MjModel], rows: np.ndarray, inputs: _Arrays) -> dict[str, np.ndarray]:
        """Return the same of single steps, with warm starts, which the pool of rollouts does not give."""
        for name, value in inputs.items():
            rows[:, self.places[name]] = value.reshape(len(rows), -1)

        def work(data: mujoco.MjData, piece: list[int]) -> None:
            for i in piece:
                mujoco.mj_setState(models[i], data, rows[i], EVERY)
                mujoco.mj_step(models[i], data)
                mujoco.mj_getState(models[i], data, rows[i], EVERY)

        self._share(work, self.steps.memory, len(rows))
        return {name: rows[:, None, self.places[name]] for name in MOTION} | {
            "warmstart": rows[:, self.places["warmstart"]]
        }

    def _run(self, models: list[mujoco.MjModel], rows: np.ndarray, inputs: _Arrays) -> dict[str, np.ndarray]:
        user = rows[:, self.places["ctrl"].start : self.places["mocap_quat"].stop]
        given = np.repeat(user[:, None], inputs["ctrl"].shape[1], axis=1)
        for name, value in inputs.items():
            place = self.places[name].start - self.places["ctrl"].start
            width = math.prod(value.shape[2:])
            given[..., place : place + width] = value.reshape(*value.shape[:2], width)
        step, warm = self.steps, rows[:, self.places["warmstart"]]
        full = step.full(rows)
        found = step.rollout.rollout(models, step.memory, full, given, control_spec=USER, initial_warmstart=warm)
        return step.motions(np.asarray(found[0]))

    def steer(
        self, num_substeps: int, dtype: np.dtype, numbers: _Arrays, start: _Arrays, law: _Arrays
    ) -> dict[str, np.ndarray]:
        """Return states and controls under a law: a gain corrects controls by the distance from nominal states, within limits."""
        # A control is rounded to a type, so that a rollout of it is the same motion, and is held for some time steps.
        with self.lock, collected():
            batch, numbers, start, law = self._flat(np.ndim(start["time"]) - 1, numbers, start, law)
            models = self._models(numbers, len(start["time"]))
            nq, nv, bits = self.mj_model.nq, self.mj_model.nv, mujoco.mjtState
            motion = bits.mjSTATE_QPOS.value | bits.mjSTATE_QVEL.value | bits.mjSTATE_ACT.value
            found = {"states": np.zeros(law["states"].shape), "controls": np.zeros(law["controls"].shape, dtype)}
            columns = (*(law[name] for name in ("states", "controls", "gain")), *found.values())
            rows = self._rows(start)

            @np.errstate(invalid="ignore", over="ignore")
            def work(data: mujoco.MjData, piece: list[int]) -> None:
                away, ctrl = np.zeros(law["gain"].shape[3]), data.ctrl
                for i in piece:
                    state = law["states"][i, 0]
                    follows, lower, upper = (law[name][i] for name in ("follows", "lower", "upper"))
                    mujoco.mj_setState(models[i], data, rows[i], EVERY)
                    mujoco.mj_setState(models[i], data, state, motion)
                    for nominal, control, gain, end, chosen in zip(*(x[i] for x in columns), strict=True):
                        if follows:
                            mujoco.mj_differentiatePos(models[i], away[:nv], 1.0, nominal[:nq], state[:nq])
                            np.subtract(state[nq:], nominal[nq:], out=away[nv:])
                            control = control + gain @ away
                        np.minimum(np.maximum(control, lower), upper, out=chosen)
                        ctrl[:] = chosen
                        mujoco.mj_step(models[i], data, num_substeps)
                        mujoco.mj_getState(models[i], data, end, motion)
                        state = end

            self._share(work, self.steps.memory, len(models))
        return {name: value.reshape(*batch, *value.shape[1:]) for name, value in found.items()}

    def maps(
        self, numbers: _Arrays, before: _Arrays, inputs: _Arrays, flight: np.ndarray, *,
        gradient: str, wanted: tuple[str, ...],
    ) -> dict[str, np.ndarray]:  # fmt: skip
        """Return the derivatives of the steps of motions in tangent space, by "state" and by each input and number wanted."""
        # Numbers are those of the model that differ from the file's; states before each step, and inputs, have an
        # axis of steps. Where those of `flight.PAIRS` are wanted pairs of motions are followed from step to step,
        # beginning with those in `flight`, packed; "flight" has them after the last.
        with self.lock, collected():
            ndim = np.ndim(before["time"]) - 2
            batch, numbers, states, inputs, rest = self._flat(ndim, numbers, before, inputs, {"flight": flight})
            # Nearly the acceleration that a solve will find.
            states["warmstart"] = np.zeros_like(states["qvel"])
            states["warmstart"][:, :-1] = np.diff(states["qvel"], axis=1) / self.mj_model.opt.timestep
            num, steps = inputs["ctrl"].shape[:2]
            flight = rest["flight"]
            if "apart" not in wanted and all(len(x) == 1 for x in numbers.values()):  # each step is a piece of its own
                states, inputs = (
                    {k: x.reshape(num * steps, 1, *x.shape[2:]) for k, x in y.items()} for y in (states, inputs)
                )
                flight = np.zeros((num * steps, 0))
            found = self._found(numbers, states, inputs, flight, gradient=gradient, wanted=wanted)
        if "apart" in wanted and not flight.any():
            self._heed(numbers, states, inputs, found)
        own = {name: x.shape[1:] if name in ONCE else (steps, *x.shape[2:]) for name, x in found.items()}
        return {name: found[name].reshape(*batch, *own[name]) for name in ("state", *wanted)}

    def _heed(self, numbers: _Arrays, before: _Arrays, inputs: _Arrays, found: _Arrays) -> None:
        """Warn, once, if slopes multiply: in the first, second, fourth batch and so on, so that it costs next to nothing."""
        self.looks += 1
        if self.has_warned or self.looks & (self.looks - 1):
            return
        if told := multiplied(self.run, self.mj_model, self.layout, numbers, before, inputs, found):
            self.has_warned = True
            warnings.warn(told, SlopeWarning, stacklevel=2)

    def _found(
        self, numbers: _Arrays, before: _Arrays, inputs: _Arrays, flight: np.ndarray, *,
        gradient: str, wanted: tuple[str, ...],
    ) -> dict[str, np.ndarray]:  # fmt: skip
        """Return the same of one axis of motions, by this process or, where that takes long, by several."""
        num, steps = inputs["ctrl"].shape[:2]
        sizes = {k: math.prod(v.shape[2:]) for k, v in inputs.items()}
        sizes |= {k: math.prod(v.shape[1:]) for k, v in numbers.items()}
        shapes = {k: (num, *v) if k in ONCE else (num, steps, *v) for k, v in self.shapes(wanted, sizes).items()}

        def arguments(piece: slice) -> tuple:
            parts = (_part(piece, num, one) for one in (numbers, before, inputs))
            return (*parts, flight[piece], gradient, wanted)

        everything = slice(0, num)
        is_long = self._is_long(num * steps, lambda: arguments(slice(0, 1)), shapes)
        if is_long and (shared := self._by_processes("write", num, shapes, arguments)):
            return shared
        found = {name: np.zeros(shape) for name, shape in shapes.items()}
        began = time.perf_counter()
        self.write(found, *arguments(everything))
        self.spent += time.perf_counter() - began
        return found

    def _by_processes(
        self, method: str, num: int, shapes: Mapping[str, tuple[int, ...]], arguments: Callable[[slice], tuple]
    ) -> dict[str, np.ndarray] | None:
        """Return arrays that processes have written by a method of theirs; nothing where one has ended."""
        try:
            return processes(self.num_threads).share(self.number, self.mj_model, num, shapes, arguments, method)
        except OSError as problem:
            self.may_share = False
            warnings.warn(f"derivatives are taken by one process, which is slower: {problem}", stacklevel=2)
            return None

    def _is_long(self, count: int, first: Callable[[], tuple], shapes: Mapping[str, tuple[int, ...]]) -> bool:
        """Return whether several processes should take so many steps, by the time that a first one takes."""
        if count < _FEWEST or self.num_threads < 2 or not self.may_share or not are_possible():
            return False
        if self.pace == 0.0:
            numbers, before, inputs, _, gradient, _ = first()
            before, inputs = ({k: x[:, :1] for k, x in part.items()} for part in (before, inputs))
            found = {name: np.zeros((1, 1, *shapes[name][2:])) for name in ("state", "ctrl") if name in shapes}
            for _ in range(2):  # a thread's first takes longer
                began = time.perf_counter()
                self.write(found, numbers, before, inputs, np.zeros((1, 0)), gradient, tuple(found)[1:])
                self.pace = time.perf_counter() - began
        foretold = count * self.pace / self.num_threads
        return foretold > (_SHORT if are_started() else max(_SHORT, _LONG - self.spent))

    def write(
        self, found: Mapping[str, np.ndarray], numbers: _Arrays, before: _Arrays, inputs: _Arrays, flight: np.ndarray,
        gradient: str, wanted: tuple[str, ...],
    ) -> None:  # fmt: skip
        """Write derivatives of the steps of motions into arrays of zeros."""
        num, steps = inputs["ctrl"].shape[:2]
        flat = {k: v.reshape(num * steps, *v.shape[2:]) for k, v in found.items() if k not in ONCE}
        models = self._models(numbers, num)
        work = self._work(models, numbers, before, inputs, gradient, flat)
        self._share(lambda worker, piece: worker.fill(work, piece), self.workers, len(work.rows))
        if "apart" not in wanted:
            return
        place = lambda motion, t: motion * steps + t  # noqa: E731
        course = Course(
            work.rows.reshape(num, steps, -1),
            found["state"],
            {divmod(i, steps): one for i, one in work.begun.items()},
            lambda motion, t: work.chosen.get(place(motion, t), work.models[place(motion, t)]),
            work.is_finite.reshape(num, steps),
        )
        pairs = Flight.unpacked(flight, self.layout, course.rows[:, 0])
        by_speed = slope.TRAVEL * models[0].opt.timestep * self.lengths
        scale = np.concatenate([self.lengths, by_speed, np.zeros(self.layout.num_rest)])
        fly(pairs, course, self.layout, scale, self.steps, found)
        if "flight" in wanted:
            ends = course.rows[:, -1].copy()
            if (chosen := np.flatnonzero((pairs.widths > 0).any(axis=1))).size:
                ends[chosen] = self.steps(ends[chosen], [models[k] for k in chosen])
            found["flight"][:] = pairs.packed(self.layout, ends)

    def _work(
        self,
        models: list,
        numbers: _Arrays,
        states: _Arrays,
        inputs: _Arrays,
        gradient: str,
        found: dict[str, np.ndarray],
    ) -> Steps:
        """Return the steps from states that have axes of motions and times."""
        num, times = inputs["ctrl"].shape[:2]
        rows = self._rows({k: v.reshape(num * times, *v.shape[2:]) for k, v in {**states, **inputs}.items()})
        exact = {id(model): self._exact(model) for model in models}
        speeds: dict[int, list] = {}
        for model, course in zip(models, states["qvel"], strict=True):
            speeds.setdefault(id(exact[id(model)]), []).append(course[np.isfinite(course).all(axis=1)])
        reached = {key: np.concatenate(courses) for key, courses in speeds.items()}
        by = {k.removeprefix(_RATES): x for k, x in numbers.items() if k.startswith(_RATES)}
        rates = {id(exact[id(model)]): {k: x[i % len(x)] for k, x in by.items()} for i, model in enumerate(models)}
        every = [exact[id(model)] for model in models for _ in range(times)]
        return Steps(rows, every, reached, gradient, found, np.zeros(len(rows), bool), rates)

    def sense(
        self, numbers: _Arrays, states: _Arrays, inputs: _Arrays, *, wanted: tuple[str, ...] = ()
    ) -> dict[str, np.ndarray]:
        """Return the "readings" of all sensors in states, or their derivatives by "state" and what else is wanted."""
        # States and inputs have an axis of times. Differences are small ones: sensors do not know of events.
        with self.lock, collected():
            batch, numbers, states, inputs = self._flat(np.ndim(states["time"]) - 2, numbers, states, inputs)
            num, times = inputs["ctrl"].shape[:2]
            sizes = {k: math.prod(v.shape[2:]) for k, v in inputs.items()} | {"state": self.layout.num_changes}
            sizes |= {k: math.prod(v.shape[1:]) for k, v in numbers.items()}
            count = self.mj_model.nsensordata
            shapes = {name: (num, times, count, sizes[name]) for name in wanted} or {"readings": (num, times, count)}
            parts = lambda piece: tuple(_part(piece, num, one) for one in (numbers, states, inputs))  # noqa: E731
            is_long = wanted and num * times >= _MANY and are_started() and self.may_share and are_possible()
            found = self._by_processes("write_sensed", num, shapes, parts) if is_long else None
            if found is None:
                found = {name: np.zeros(shape) for name, shape in shapes.items()}
                self.write_sensed(found, *parts(slice(0, num)))
        return {name: value.reshape(*batch, *value.shape[1:]) for name, value in found.items()}

    def write_sensed(self, found: Mapping[str, np.ndarray], numbers: _Arrays, states: _Arrays, inputs: _Arrays) -> None:
        """Write readings, or their derivatives, into arrays of zeros."""
        num, times = inputs["ctrl"].shape[:2]
        flat = {k: v.reshape(num * times, *v.shape[2:]) for k, v in found.items()}
        work = self._work(self._models(numbers, num), numbers, states, inputs, "discrete", flat)
        # Derivatives are many short calls, which two threads of Python make half as fast as one.
        workers = self.workers if "readings" in found else self.workers[:1]
        self._share(lambda worker, piece: worker.sense(work, piece), workers, num * times)

    def product(self, numbers: _Arrays, start: _Arrays, inputs: _Arrays, *, gradient: str) -> dict[str, np.ndarray]:
        """Return the derivative of the end of a motion by its start and by controls that are held, and "end", the state there."""
        # MuJoCo's own differences are taken where they are right, see `Worker.differences`: they are five times faster.
        batch, *given = self._flat(np.ndim(start["time"]) - 1, numbers, start, inputs)
        (num, steps), size, nu = given[2]["ctrl"].shape[:2], self.layout.num_changes, self.mj_model.nu
        found: dict[str, np.ndarray] = {"state": np.zeros((num, size, size)), "ctrl": np.zeros((num, size, nu))}
        found["end"], is_right = np.zeros((num, len(self.layout.motion))), np.zeros(num, bool)
        if gradient == "discrete":
            with self.lock, collected():
                models = [self._exact(model) for model in self._models(given[0], num)]
                rows = self._rows(given[1] | {name: value[:, 0] for name, value in given[2].items()})

                def work(worker: Worker, piece: list[int]) -> None:
                    for i in piece:
                        is_right[i] = worker.differences(models[i], rows[i], {k: x[i] for k, x in found.items()}, steps)

                self._share(work, self.workers, num)
        if (left := np.flatnonzero(~is_right)).size:
            numbers, start, inputs = (_part(left, num, one) for one in given)
            after = self.run(numbers, start, inputs)
            changes = np.broadcast_to(np.eye(size, size + nu), (len(left), size, size + nu))
            pushes = np.broadcast_to(np.eye(nu, size + nu, size), (len(left), steps, nu, size + nu))
            pushed = self._pushed(gradient, numbers, self._before(start, after), inputs, changes, pushes)
            both = np.array([course[-1] for course in pushed])
            found["state"][left], found["ctrl"][left] = both[..., :size], both[..., size:]
            end = np.concatenate([after[name][:, -1] for name in MOTION], axis=-1)
            found["end"][left] = np.where(np.isfinite(end).all(axis=-1, keepdims=True), end, np.nan)
        return {name: value.reshape(*batch, *value.shape[1:]) for name, value in found.items()}

    def follow(
        self, gradient: str, numbers: _Arrays, start: _Arrays, inputs: _Arrays, changes: tuple[np.ndarray, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return a motion as `run` does and, as "change", what becomes of a change of the start and of the controls."""
        after = self.run(numbers, start, inputs)
        before = self._before(start, after)
        if gradient == "discrete":
            change = self._along(numbers, before, inputs, *changes)
        else:
            change = np.array(list(self._pushed(gradient, numbers, before, inputs, *changes)))
        return after | {"change": change}

    def _pushed(
        self, gradient: str, numbers: _Arrays, before: _Arrays, inputs: _Arrays, changes: np.ndarray, pushes: np.ndarray
    ) -> Iterator[list[np.ndarray]]:
        """Give what becomes of changes of each motion's start and controls, of one column or several, after each step."""
        (num, steps), size = before["qvel"].shape[:2], self.layout.num_changes
        wanted = ("ctrl",) if pushes.any() else ()
        names = with_pairs(wanted) if gradient == "slope" and steps > 1 else wanted
        together = max(1, int(_MOST_NUMBERS / (steps * size * (2 * size + NUM_SLOTS))))
        for first in range(0, num, together):
            motions = range(num)[first : first + together]
            cut, flight = functools.partial(_part, slice(first, first + together), num), self.no_flight((len(motions),))
            found = self.maps(cut(numbers), cut(before), cut(inputs), flight, gradient=gradient, wanted=names)
            for k, motion in enumerate(motions):
                main, course = changes[motion], []
                held = np.zeros((NUM_SLOTS, *main.shape[1:]))
                for t, push in enumerate(pushes[motion]):
                    one = {name: found[name][k, t] for name in ("state", *PAIRS) if name in found}
                    one |= {"by state": found["ctrl"][k, t] @ push if wanted else 0.0, "by felt": 0.0}
                    main, held, total = advance(np, main, held, one)
                    course.append(total)
                yield course

    @np.errstate(invalid="ignore", over="ignore")
    def _along(
        self, numbers: _Arrays, before: _Arrays, inputs: _Arrays, main: np.ndarray, pushes: np.ndarray
    ) -> np.ndarray:
        """Return what becomes of changes by differences of whole steps along them: three steps each, not a hundred."""
        # Where the two sides differ as at a jump, or one is beyond the limits of a control, the other one counts.
        with self.lock, collected():
            _, numbers, before, inputs = self._flat(1, numbers, before, inputs)
            models = [self._exact(model) for model in self._models(numbers, len(main))]
            controls, timestep = self.places["ctrl"], models[0].opt.timestep
            low, high = np.where(
                self.mj_model.actuator_ctrllimited, self.mj_model.actuator_ctrlrange.T, [[-np.inf], [np.inf]]
            )
            found, sides = [], np.array([1.0, 0.0, -1.0])[:, None, None]
            for t in range(pushes.shape[1]):
                rows, push = self._rows({k: x[:, t] for k, x in {**before, **inputs}.items()}), pushes[:, t]
                size = np.abs(np.concatenate([main, push], axis=1)).max(axis=1, keepdims=True)
                width = WIDTH / np.where(size > 0, size, 1.0)
                starts = self.layout.moved(rows, sides * width * main)
                starts[..., controls] += sides * width * push
                ends = self.steps(starts.reshape(-1, starts.shape[-1]), 3 * models).reshape(starts.shape)
                both = self.layout.difference(ends[:2], ends[1:]) / width
                is_within = (low <= starts[1, :, controls]) & (starts[1, :, controls] <= high)
                ahead, behind = (
                    is_within & ((x < low) | (x > high)) for x in (starts[0, :, controls], starts[2, :, controls])
                )
                sizes = np.linalg.norm(both, axis=2)
                is_jump = np.linalg.norm(both[0] - both[1], axis=1) > APART * sizes.max(axis=0)
                is_jump &= sizes.max(axis=0) > np.linalg.norm(main, axis=1) / timestep
                first = np.where(is_jump, sizes[0] < sizes[1], True) & ~ahead.any(axis=1)
                last = np.where(is_jump, sizes[1] <= sizes[0], True) & ~behind.any(axis=1)
                share = np.stack([first, last]) / np.maximum(first.astype(int) + last, 1)
                main = np.nan_to_num(np.sum(share[..., None] * both, axis=0), posinf=0.0, neginf=0.0)
                found.append(main)
        return np.stack(found, axis=1)

    def no_flight(self, batch: tuple[int, ...]) -> np.ndarray:
        return np.zeros((*batch, *self.flight_shape))

    @property
    def flight_shape(self) -> tuple[int, int]:
        return NUM_SLOTS, 2 * self.layout.num_changes + 3

    def shapes(self, wanted: tuple[str, ...], sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the derivatives of one step, of its end by all that is wanted."""
        # Those of `ONCE` belong to a whole motion.
        model, size = self.mj_model, self.layout.num_changes
        own = {"felt": (model.nv, size), "slot": (model.nv,), "apart": (size, NUM_SLOTS), "stays": (NUM_SLOTS,)}
        own |= {"before": (size, NUM_SLOTS), "enters": (NUM_SLOTS,), "flight": self.flight_shape}
        own |= {k: (model.nv if k.startswith("felt") else size, sizes[k.split()[-1]]) for k in wanted if k not in own}
        return {"state": (size, size)} | {k: own[k] for k in wanted}

    def _before(self, start: _Arrays, after: _Arrays) -> dict[str, np.ndarray]:
        found = {}
        for name in MOTION:
            first = np.asarray(start[name], float)[..., None, :] if name in start else self.template[self.places[name]]
            first = np.broadcast_to(first, (*after[name].shape[:-2], 1, after[name].shape[-1]))
            found[name] = np.concatenate([first, after[name][..., :-1, :]], axis=-2)
        steps = after["qpos"].shape[-2]
        times = self.mj_model.opt.timestep * np.arange(steps)[:, None]
        return found | {"time": np.asarray(start["time"], float)[..., None, :] + times}

    def _exact(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """Return a model as it is differentiated; the last is kept."""
        if model is not self.exact[0]:
            self.exact = (model, solved(model))
        return self.exact[1]

    def _share(self, work: Callable, workers: list, count: int) -> None:
        pieces = [piece.tolist() for piece in np.array_split(np.arange(count), min(len(workers), count))]
        list(map(work, workers, pieces) if len(pieces) == 1 else self.threads.map(work, workers, pieces))

    def _flat(self, ndim: int, numbers: _Arrays, *arrays: _Arrays) -> tuple:
        """Return the batch's shape, numbers and arrays with one axis for it; that of numbers that are shared has length one."""
        values = {name: np.asarray(value) for name, value in numbers.items()}
        given = [{k: self._exactly(k, v) for k, v in one.items()} for one in arrays]
        batch = np.broadcast_shapes(*(x.shape[:ndim] for one in (*given, values) for x in one.values()))

        def flat(x: np.ndarray) -> np.ndarray:
            return np.broadcast_to(x, batch + x.shape[ndim:]).reshape(math.prod(batch), *x.shape[ndim:])

        flattened = {
            k: flat(v) if math.prod(v.shape[:ndim]) > 1 else v.reshape(1, *v.shape[ndim:]) for k, v in values.items()
        }
        return batch, flattened, *({k: flat(v) for k, v in one.items()} for one in given)

    def _models(self, numbers: _Arrays, count: int) -> list[mujoco.MjModel]:
        """Return a model for each of so many motions, of numbers that have an axis of them, or one of length one."""
        shared = {k: x[0] for k, x in numbers.items() if len(x) == 1}
        content = {k: x.tobytes() for k, x in shared.items()}
        if content != self.kept[0]:
            self.kept = (content, with_numbers(self.plain, shared))
        base, varied = self.kept[1], {k: x for k, x in numbers.items() if len(x) > 1}
        if not varied:
            return [base] * count
        return [with_numbers(base, {name: x[i] for name, x in varied.items()}) for i in range(count)]

    def _exactly(self, name: str, value: np.ndarray) -> np.ndarray:
        """Return an array in double precision; positions that single precision rounded have the digits of the file again."""
        # A body that stands on the floor in the file would else begin a nanometre above or below it.
        given = np.asarray(value)
        found = given.astype(float)
        if name in ("qpos", "states") and given.dtype == np.float32:  # of a law, whose states begin with positions
            nq = self.mj_model.nq
            for pose in self.poses:
                np.copyto(found[..., :nq], pose, where=given[..., :nq] == pose.astype(np.float32))
        return found

    def _rows(self, start: _Arrays) -> Float[np.ndarray, "rows size"]:
        rows = np.tile(self.template, (len(start["time"]), 1))
        for name, value in start.items():
            rows[:, self.places[name]] = value.reshape(len(rows), math.prod(value.shape[1:]))
        return rows


def _part(part: slice | np.ndarray, count: int, arrays: _Arrays) -> dict[str, np.ndarray]:
    return {name: value[part] if len(value) == count else value for name, value in arrays.items()}
