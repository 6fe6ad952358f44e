"""C MuJoCo on all cores: batches of rollouts, and the Jacobians of their steps by differences."""

import copy
import functools
import math
import os
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from mjxgrad.native.events import Surfaces, levers_of
from mjxgrad.scene.scene import with_numbers

Gradient = Literal["discrete", "slope"]
INPUTS = ("ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat")
"""What may be given to each step, in the order in which MuJoCo keeps it."""
START = ("time", "qpos", "qvel", "act")
_STATE = mujoco.mjtState
_USER = _STATE.mjSTATE_USER.value & ~_STATE.mjSTATE_USERDATA.value
_FULL, _ALL = _STATE.mjSTATE_FULLPHYSICS.value, _STATE.mjSTATE_INTEGRATION.value
_NUM_THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_WIDTH = 1e-6  # of small differences, as MuJoCo's own documentation has it; of parameters as a share of their value
_TOLERANCE, _ITERATIONS = 1e-14, 200  # of the steps that are subtracted: what a solve leaves is divided by the width

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
        self.data = [mujoco.MjData(mj_model) for _ in range(_NUM_THREADS)]
        self.start = mujoco.MjData(mj_model)
        self.levers = levers_of(mj_model)
        self.places = {
            one: mujoco.mj_stateSize(mj_model, _ALL & (getattr(_STATE, f"mjSTATE_{one.upper()}").value - 1))
            for one in (*START, "warmstart", *INPUTS)
        }

    def run(self, numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> dict[str, np.ndarray]:
        """Return positions, velocities and activations after each step."""
        with self.lock, _quietly():
            batch, models, start, inputs = self._flat(np.ndim(start["time"]) - 1, numbers, start, inputs)
            rows = self._rows(start)
            full, user = (self._part(rows, spec) for spec in (_FULL, _USER))
            given = np.repeat(user[:, None], inputs["ctrl"].shape[1], axis=1)
            for name, value in inputs.items():
                place = self.places[name] - self.places["ctrl"]
                width = math.prod(value.shape[2:])
                given[..., place : place + width] = value.reshape(*value.shape[:2], width)
            found = self.pool.rollout(models, self.data, full, given, control_spec=_USER)[0]
        ends = np.cumsum([1, self.mj_model.nq, self.mj_model.nv, self.mj_model.na])
        parts = np.split(np.asarray(found), ends, axis=2)[1:4]
        return {name: part.reshape(*batch, *part.shape[1:]) for name, part in zip(START[1:], parts, strict=True)}

    def linearise(
        self, gradient: Gradient, wanted: tuple[str, ...], numbers: _Arrays, start: _Arrays, inputs: _Arrays
    ) -> dict[str, np.ndarray]:
        """Return the Jacobians of single steps in tangent space, by "state" and by each input and number that is wanted.

        States before each step are in `start`, with an axis of steps as inputs have it.
        """
        with self.lock, _quietly():
            batch, models, start, inputs = self._flat(np.ndim(start["time"]) - 2, numbers, start, inputs)
            steps = inputs["ctrl"].shape[1]
            rows = self._rows({k: v.reshape(len(models) * steps, *v.shape[2:]) for k, v in (start | inputs).items()})
            size = 2 * self.mj_model.nv + self.mj_model.na
            sizes = {
                one: np.asarray(numbers[one]).size // max(1, _leading(numbers[one], batch))
                for one in wanted
                if one in numbers
            }
            widths = {"state": size} | {one: sizes.get(one, self._width(one)) for one in wanted}
            found = {name: np.zeros((len(rows), size, width)) for name, width in widths.items()}
            pieces = np.array_split(np.arange(len(rows)), min(_NUM_THREADS, len(rows)))

            def work(thread: int) -> None:
                _Linearisation(self, self.data[thread], gradient).fill(
                    models, start["qvel"], rows, pieces[thread], found
                )

            list(self.threads.map(work, range(len(pieces))))
        return {name: value.reshape(*batch, steps, *value.shape[1:]) for name, value in found.items()}

    def _flat(self, ndim: int, numbers: _Arrays, start: _Arrays, inputs: _Arrays) -> tuple:
        """Return the batch's shape, one model for each of it or for all, and the arrays with one axis for the batch's."""
        values = {name: np.asarray(value) for name, value in numbers.items()}
        given = [{k: np.asarray(v, float) for k, v in one.items()} for one in (start, inputs)]
        batch = np.broadcast_shapes(*(x.shape[:ndim] for one in (*given, values) for x in one.values()))

        def flat(x: np.ndarray) -> np.ndarray:
            return np.broadcast_to(x, batch + x.shape[ndim:]).reshape(math.prod(batch), *x.shape[ndim:])

        varied = {name: flat(x) for name, x in values.items() if math.prod(x.shape[:ndim]) > 1}
        base = with_numbers(self.mj_model, {k: x.reshape(x.shape[ndim:]) for k, x in values.items() if k not in varied})
        # A state that is not finite stays so, and is seen.
        base.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
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
            rows[:, self._place(name)] = value.reshape(len(rows), math.prod(value.shape[1:]))
        return rows

    def _part(self, rows: np.ndarray, spec: int) -> np.ndarray:
        """Return what of whole states belongs to a part of them."""
        found = np.zeros((len(rows), mujoco.mj_stateSize(self.mj_model, spec)))
        for row, part in zip(rows, found, strict=True):
            mujoco.mj_extractState(self.mj_model, row, _ALL, part, spec)
        return found

    def _width(self, name: str) -> int:
        return mujoco.mj_stateSize(self.mj_model, getattr(_STATE, f"mjSTATE_{name.upper()}").value)

    def _place(self, name: str) -> slice:
        return slice(self.places[name], self.places[name] + self._width(name))


class _Linearisation:
    """The Jacobians of steps by one thread."""

    def __init__(self, engine: Engine, data: mujoco.MjData, gradient: Gradient):
        self.engine, self.data, self.gradient = engine, data, gradient
        self.models: tuple[mujoco.MjModel | None, ...] = (None, None)

    def fill(self, models: list, speeds: np.ndarray, rows: np.ndarray, index: np.ndarray, found: dict) -> None:
        """Write the Jacobians of chosen rows; rows of one trajectory, which share a model, follow each other."""
        num_steps = len(rows) // len(models)
        for i in index.tolist():
            trajectory = i // num_steps
            if models[trajectory] is not self.models[0]:
                model = copy.deepcopy(models[trajectory])
                model.opt.tolerance, model.opt.iterations = _TOLERANCE, max(_ITERATIONS, model.opt.iterations)
                self.models = (models[trajectory], model)
                if self.gradient == "slope":
                    alike = [k for k, one in enumerate(models) if one is models[trajectory]]
                    self.surfaces = Surfaces(model, self.engine.levers, speeds[alike].reshape(-1, model.nv))
                    self.far = mujoco.MjData(self.surfaces.model)
            if np.isfinite(rows[i]).all():
                self._one(self.models[1], rows[i].copy(), {name: value[i] for name, value in found.items()})

    def _one(self, model: mujoco.MjModel, row: np.ndarray, found: dict[str, np.ndarray]) -> None:
        engine, data = self.engine, self.data
        _, after, _ = self._step(model, row)
        if not np.isfinite(after).all():
            return
        row[engine._place("warmstart")] = data.qacc_warmstart
        events, clear = None, row
        if self.gradient == "slope":
            before = row[engine._place("qvel")].copy()
            mujoco.mj_setState(self.surfaces.model, self.far, row, _ALL)
            events = self.surfaces.events(self.far, before, after)
        if events is not None:
            # Small differences stay on one side of every surface.
            near = 4 * _WIDTH * np.abs(events.rows).max(axis=1)
            side = np.where(events.gaps < 0, -near, near)
            clear = self._moved(
                model, row, events.moves @ np.where(np.abs(events.gaps) < near, side - events.gaps, 0.0)
            )
            if self.surfaces.lead:
                for move, width in zip(events.moves.T, near / 4, strict=True):
                    clear = self._off_stages(model, clear, width * move)
        self._small(model, clear, found)
        if events is not None:
            matrix, spanned = found["state"], np.zeros((len(found["state"]), len(events.gaps)))
            for k, (gap, width) in enumerate(zip(events.gaps, events.widths, strict=True)):
                ends = [self._moved(model, row, (end - gap) * events.moves[:, k]) for end in (width, -width)]
                spanned[:, k] = self._difference(model, *ends) / (2 * width)
            jump, nv = (spanned - matrix[:, : model.nv] @ events.moves) @ events.rows, model.nv
            matrix[:, :nv] += jump
            matrix[:, nv : 2 * nv] += self.surfaces.lead * jump

    def _off_stages(self, model: mujoco.MjModel, row: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return a state near which no stage of RK4 meets a surface: there differences of any width are alike."""
        for _ in range(4):  # RK4's stages, whose places acceleration moves, so that they are not known beforehand
            near, far = (
                self._difference(model, *(self._moved(model, row, side * width * change) for side in (1, -1))) / width
                for width in (1, 4)
            )
            if np.linalg.norm(near - far) <= 0.1 * np.linalg.norm(far):
                break
            row = self._moved(model, row, 8 * change)
        return row

    def _small(self, model: mujoco.MjModel, row: np.ndarray, found: dict[str, np.ndarray]) -> None:
        """Write differences of small width by all that is wanted."""
        matrix, by_control = found["state"], found.get("ctrl", np.zeros((len(found["state"]), model.nu)))
        if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:  # which MuJoCo's own function refuses
            for column, change in enumerate(np.eye(len(matrix))):
                ends = [self._moved(model, row, side * _WIDTH * change) for side in (1, -1)]
                matrix[:, column] = self._difference(model, *ends) / (2 * _WIDTH)
        else:
            mujoco.mj_setState(model, self.data, row, _ALL)
            mujoco.mjd_transitionFD(model, self.data, _WIDTH, True, matrix, by_control, None, None)
        done = ("state",) if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else ("state", "ctrl")
        for name, jacobian in found.items():
            if name in done:
                continue
            if name in INPUTS:
                place = self.engine.places[name]
                for column in range(jacobian.shape[1]):
                    ends = [row.copy(), row.copy()]
                    for end, side in zip(ends, (1, -1), strict=True):
                        end[place + column] += side * _WIDTH
                    jacobian[:, column] = self._difference(model, *ends) / (2 * _WIDTH)
            else:
                self._by_number(model, row, name, jacobian)

    def _by_number(self, model: mujoco.MjModel, row: np.ndarray, name: str, jacobian: np.ndarray) -> None:
        """Write differences by the entries of an array of the model."""
        holder = model.opt if name.startswith("opt.") else model
        attribute = name.removeprefix("opt.")
        present = getattr(holder, attribute, None)
        if not isinstance(present, float | np.ndarray):
            return
        values = np.array(present, float).reshape(-1)

        def at(column: int, value: float) -> list[np.ndarray]:
            if isinstance(present, float):
                setattr(holder, attribute, value)
            else:
                present.reshape(-1)[column] = value
            return self._step(model, row)

        for column, value in enumerate(values.tolist()):
            width = 10 * _WIDTH * abs(value) or _WIDTH
            above, below = at(column, value + width), at(column, value - width)
            at(column, value)
            jacobian[:, column] = _change(model, above, below) / (2 * width)

    def _step(self, model: mujoco.MjModel, row: np.ndarray) -> list[np.ndarray]:
        mujoco.mj_setState(model, self.data, row, _ALL)
        mujoco.mj_step(model, self.data)
        return [self.data.qpos.copy(), self.data.qvel.copy(), self.data.act.copy()]

    def _difference(self, model: mujoco.MjModel, above: np.ndarray, below: np.ndarray) -> Float[np.ndarray, " size"]:
        return _change(model, self._step(model, above), self._step(model, below))

    def _moved(self, model: mujoco.MjModel, row: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return a state moved in tangent space: by its position, or by position, velocity and activation."""
        moved, nv = row.copy(), model.nv
        mujoco.mj_integratePos(model, moved[self.engine._place("qpos")], change[:nv], 1.0)
        if len(change) > nv:
            moved[self.engine._place("qvel")] += change[nv : 2 * nv]
            moved[self.engine._place("act")] += change[2 * nv :]
        return moved


def _change(model: mujoco.MjModel, above: list[np.ndarray], below: list[np.ndarray]) -> Float[np.ndarray, " size"]:
    """Return one state less another in tangent space."""
    positions = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, positions, 1.0, below[0], above[0])
    return np.concatenate([positions, above[1] - below[1], above[2] - below[2]])


def _leading(value: np.ndarray, batch: tuple[int, ...]) -> int:
    return math.prod(np.shape(value)[: len(batch)])


class _quietly:  # noqa: N801 - a context, used as a word
    """Numbers that are not finite are seen in the result; MuJoCo would write them into a file."""

    def __enter__(self) -> None:
        mujoco.set_mju_user_warning(lambda _: None)

    def __exit__(self, *_) -> None:
        mujoco.set_mju_user_warning(None)
