r"""Problems of `mujoco.sysid`, solved with derivatives of the simulation.

There a parameter is a piece of Python that edits an `MjSpec`, which cannot be differentiated; and so the whole simulation is
simulated again for each parameter. Here the two halves are taken apart. From parameters to the numbers of the compiled model is
cheap and smooth: central differences of compiled models. From these numbers to the motion is the simulation: exact derivatives.
The product is the derivative by the parameter, whatever its piece of Python does.

Principal moments and axes of inertia are differenced as the pseudo-inertia: the compiler may swap axes, the tensor is smooth.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from mjxgrad._rollout import initial_state
from mjxgrad.dynamics import Gradient, Onset
from mjxgrad.dynamics.constants import constants_of
from mjxgrad.identification.inertia import body_fields, second_moments
from mjxgrad.identification.parameters import Coordinates, Parameter
from mjxgrad.identification.recording import Recording
from mjxgrad.identification.result import Identification
from mjxgrad.identification.search import Experiment, Log, search
from mjxgrad.scene import Scene, load_scene
from mjxgrad.scene.scene import numbers_of

_Column = tuple[np.ndarray, np.ndarray, bool]
Build = Callable[[Any, mujoco.MjSpec], mujoco.MjModel]
_BODY = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
_STATE_KINDS = {"MjStateQPos": "qpos", "MjStateQVel": "qvel", "MjStateAct": "act"}
_STEP = 6e-6  # of the range: the cube root of double precision, for central differences
# What the compiler notes of a model and a simulation in JAX does not read.
_NOT_READ = ("sameframe", "simple", "signature", "plugin")


def identify_sequences(
    parameters: Any,
    sequences: Sequence[Any],
    *,
    build_model: Build | None = None,
    sensor_weights: dict[str, float] | None = None,
    held_out: Sequence[str] = (),
    free_start: bool = False,
    onset: Onset | None = None,
    gradient: Gradient = "discrete",
    max_steps: int = 100,
    log: Log | None = None,
) -> tuple[Any, Identification]:
    """Find the parameters of a problem of `mujoco.sysid`.

    Residuals are those of its `build_residual_fn`: each column by its own size, sensors as its rollout returns them, one step
    late, and everything between steps interpolated linearly. Orientations are compared by the rotation between them. Neither
    `modify_residual` nor a `SignalTransform` is read.

    Args:
        parameters: a `ParameterDict`. The search begins at the values, not at the nominal ones, and leaves out frozen parameters.
        sequences: of `ModelSequences`. Their specs are copied, not changed.
        build_model: from parameters and a spec to a C model; None applies the parameters' modifiers and compiles.
        sensor_weights: by name of a sensor.
        held_out: names of sequences that are only judged by.
        free_start: as of `identify`.
        onset: as of `identify`; None is the motion of `mujoco.sysid`.
        gradient: as of `identify`.
        max_steps: as of `identify`.
        log: as of `identify`.

    Returns:
        A copy of the parameters with the values found, for `save_to_disk` and other functions of `mujoco.sysid`, and the result.

    Raises:
        ValueError: if a parameter changes what a program in JAX must know when it is compiled, such as sizes or flags, or no
            parameter is free.
        SceneError: if MJX cannot simulate a model.
    """
    free = {name: p for name, p in parameters.items() if not p.frozen}
    coordinates = Coordinates.of({name: Parameter(p.value, p.min_value, p.max_value) for name, p in free.items()})
    experiments = [
        _experiment(parameters, one, coordinates, build_model or _build, sensor_weights or {}, held_out)
        for one in sequences
    ]
    settings = {"delay": None, "free_start": free_start, "onset": onset, "gradient": gradient}
    result = search(experiments, coordinates, {}, max_steps=max_steps, log=log, **settings)
    found = parameters.copy()
    found.update_from_vector(np.concatenate([np.ravel(value) for value in result.values.values()]))
    return found, result


def _build(parameters: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
    for parameter in parameters.values():
        if not parameter.frozen:
            parameter.apply_modifier(spec)
    return spec.compile()


def _experiment(
    parameters: Any,
    sequence: Any,
    coordinates: Coordinates,
    build: Build,
    weights: dict[str, float],
    held_out: Sequence[str],
) -> Experiment:
    fields = _CompiledFields(parameters, sequence.spec, coordinates, build)
    # Not that of the start, where a damping of zero would be left out for good.
    scene = load_scene(fields.inside)
    fields.choose(scene)
    kept, judged = [], []
    for name, rollout in zip(sequence.sequence_name, sequence.measured_rollout, strict=True):
        (judged if name in held_out else kept).extend(_recordings(scene, name, rollout, weights))
    if not kept:
        raise ValueError(f"held_out must leave a sequence of {sequence.name}, got all of {sequence.sequence_name}")
    return Experiment(scene, kept, judged, fields.put, fields.at)


class _CompiledFields:
    """The numbers of a compiled model as functions of the parameters, by value and by derivative."""

    def __init__(self, parameters: Any, spec: mujoco.MjSpec, coordinates: Coordinates, build: Build):
        self._parameters, self._spec, self._build = copy.deepcopy(parameters), spec.copy(), build
        self._lower, self._upper = (np.asarray(x, float) for x in (coordinates.lower, coordinates.upper))
        start = np.asarray(coordinates.nominal, float)
        low = np.where(np.isfinite(self._lower), self._lower, start - 1)
        high = np.where(np.isfinite(self._upper), self._upper, start + 1)
        self._first = self._compile(start)
        self.inside = self._compile(low + np.random.default_rng(0).uniform(0.4, 0.6, start.shape) * (high - low))
        self._refuse_structure()
        self._names: list[str] = []
        self._bodies = np.zeros(0, int)

    def _compile(self, vector: np.ndarray) -> mujoco.MjModel:
        self._parameters.update_from_vector(np.asarray(vector, float))
        return self._build(self._parameters, self._spec)

    def choose(self, scene: Scene) -> None:
        """Note which numbers of a scene the parameters change."""
        derived = jax.eval_shape(lambda: constants_of(scene.model)).keys()
        shared = [name for name in numbers_of(scene.model) if _has(self._first, name)]
        pairs = {name: (_read(self._first, name), _read(self.inside, name)) for name in shared}
        changed = [name for name, (one, other) in pairs.items() if not np.array_equal(one, other)]
        moved = [
            (pairs[name][0] != pairs[name][1]).reshape(len(scene.model.body_mass), -1)
            for name in _BODY
            if name in changed
        ]
        if moved:
            self._bodies = np.flatnonzero(np.concatenate(moved, axis=1).any(axis=1))
        self._names = [name for name in changed if name not in (*_BODY, *derived)]

    def _refuse_structure(self) -> None:
        found = []
        for name in dir(self._first):
            if name.startswith("_") or any(part in name for part in _NOT_READ):
                continue
            before, after = getattr(self._first, name), getattr(self.inside, name)
            if not isinstance(before, int | np.ndarray):
                continue
            before, after = np.asarray(before), np.asarray(after)
            is_number = np.issubdtype(before.dtype, np.floating)
            if before.shape != after.shape or not (is_number or np.array_equal(before, after)):
                found.append(name)
        if found:
            raise ValueError(
                f"parameters must change numbers alone, got one that changes {', '.join(found)}; freeze it"
            )

    def _numbers(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        model = self._compile(vector)
        found = {name: np.array(_read(model, name)) for name in self._names}
        if self._bodies.size:
            parts = [getattr(model, name)[self._bodies] for name in _BODY]
            found["pseudo"] = np.stack([second_moments(*one) for one in zip(*parts, strict=True)])
        return found

    def at(self, vector: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return each number and its derivative by the parameters, the last axis."""
        width = np.where(
            np.isfinite(self._upper - self._lower), self._upper - self._lower, np.maximum(np.abs(vector), 1.0)
        )
        slopes: dict[str, list] = {}
        for i, step in enumerate(_STEP * width):
            ends = np.clip(vector[i] + np.array([-step, step]), self._lower[i], self._upper[i])
            below, above = (self._numbers(np.where(np.arange(len(vector)) == i, end, vector)) for end in ends)
            for name in below:
                slopes.setdefault(name, []).append((above[name] - below[name]) / (ends[1] - ends[0]))
        return {name: (value, np.stack(slopes[name], axis=-1)) for name, value in self._numbers(vector).items()}

    def put(self, scene: Scene, vector: Array, numbers: dict[str, Any]) -> Scene:
        """Return the scene with numbers whose values and derivatives by the parameters are these."""
        change = vector - jax.lax.stop_gradient(vector)  # zero, but for its derivative
        dtype = vector.dtype
        found = {name: (jnp.asarray(v, dtype) + jnp.asarray(s, dtype) @ change) for name, (v, s) in numbers.items()}
        pseudo = found.pop("pseudo", None)
        if pseudo is not None:
            for name, part in jax.vmap(body_fields)(pseudo).items():
                found[name] = getattr(scene.model, name).at[self._bodies].set(part)
        options: dict[str, Any] = {name: found.pop(name) for name in list(found) if name.startswith("opt.")}
        changed = scene.with_model(**found) if found else scene
        return eqx.tree_at(lambda s: s.model, changed, changed.model.tree_replace(options)) if options else changed


def _has(model: mujoco.MjModel, name: str) -> bool:
    """Return whether a C model has what MJX's calls by this name."""
    return hasattr(model.opt if name.startswith("opt.") else model, name.removeprefix("opt."))


def _read(model: mujoco.MjModel, name: str) -> np.ndarray:
    return np.asarray(getattr(model.opt if name.startswith("opt.") else model, name.removeprefix("opt.")))


def _recordings(scene: Scene, name: str, rollout: Any, weights: dict[str, float]) -> list[Recording]:
    """Return what was measured by sensors, and what as states, whose times differ by a step."""
    model, timestep = rollout.model, float(scene.model.opt.timestep)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, rollout.initial_state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = initial_state(scene, qpos=data.qpos, qvel=data.qvel, act=data.act)
    control, measured = rollout.control, rollout.sensordata
    num_steps = int(np.ceil((control.times[-1] - control.times[0]) / timestep - 1e-9))
    at = control.times[0] + timestep * np.arange(num_steps)
    controls = np.column_stack(
        [np.interp(at, control.times, column) for column in control.data.T] or [np.zeros((num_steps, 0))]
    )
    times = measured.times - data.time
    rows = (times > timestep * (1 - 1e-6)) & (times < timestep * (num_steps + 1e-6))
    columns = _columns(scene, model, measured, rows)
    found = []
    for is_sensor in (True, False):
        values = {key: v for key, (v, _, of_sensor) in columns.items() if of_sensor == is_sensor}
        noise = {key: n / weights.get(key, 1.0) for key, (_, n, of_sensor) in columns.items() if of_sensor == is_sensor}
        if values:
            # The rollout of `mujoco.sysid` gives sensors of the state before each step the time after it.
            moments = times[rows] - timestep * is_sensor
            found.append(Recording(values, controls, np.maximum(moments, 0), noise=noise, start=start, name=name))
    return found


def _columns(scene: Scene, model: mujoco.MjModel, measured: Any, rows: np.ndarray) -> dict[str, _Column]:
    """Return values and sizes of each signal, states as columns of the whole, and whether it is a sensor."""
    if measured.signal_mapping is None:
        raise ValueError("sensordata must say what its columns are, got no mapping: make it by TimeSeries.from_names")
    if None in measured.signal_mapping:  # as it calls what has no name, and keeps one of several
        raise ValueError("sensordata must have named signals, got one without: name the sensors in the MJCF")
    found: dict[str, _Column] = {}
    for name, (kind, place) in measured.signal_mapping.items():
        value = measured.data[rows][:, place]
        size = np.linalg.norm(value, axis=0) / np.sqrt(2)
        value = np.where(size > 0, value, np.nan)  # a column of zeros has no size to compare with
        size = np.where(size > 0, size, 1.0)
        if kind.name == "MjSensor":
            found[name] = (value, size, True)
            continue
        if kind.name not in _STATE_KINDS:
            raise ValueError(
                f"{name} must be a sensor, qpos, qvel or act, got {kind.name}: leave it out of the TimeSeries"
            )
        key = _STATE_KINDS[kind.name]
        columns, dofs = _state_columns(model, name, key)
        width = getattr(scene.data, key).shape[0]
        nothing = (np.full((len(value), width), np.nan), np.ones(model.nv if key == "qpos" else width), False)
        whole, sizes, _ = found.setdefault(key, nothing)
        whole[:, columns] = value
        if len(dofs) < len(size):  # a quaternion's components change by half the angle
            turn = 2 * np.sqrt((size[-4:] ** 2).mean())
            size = np.append(size[:-4], np.full(3, turn))
        sizes[dofs] = size
    return found


def _state_columns(model: mujoco.MjModel, name: str, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Return where a joint's, free body's or actuator's part of a state is, and which velocities it is compared as."""
    base = name.removesuffix(f"_{key}")
    if key == "act":
        actuator = model.actuator(base).id
        columns = model.actuator_actadr[actuator] + np.arange(model.actuator_actnum[actuator])
        return columns, columns
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, base)
    if joint < 0:  # free bodies go by their own names
        joint = model.body_jntadr[model.body(base).id]
    dofs = np.flatnonzero(model.dof_jntid == joint)
    last = model.jnt_qposadr[joint + 1] if joint + 1 < model.njnt else model.nq
    return (dofs if key == "qvel" else np.arange(model.jnt_qposadr[joint], last)), dofs
