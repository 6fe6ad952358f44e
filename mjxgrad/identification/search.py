r"""The search: residuals of all recordings in one program, their derivative in forward mode, and Levenberg-Marquardt.

One program rolls out all windows of a scene under `jax.vmap`, with one tangent per parameter. The unknown start of a window
affects that window alone, so the tangents of the starts do not grow with the number of windows. Each step of the search asks
this program for residuals and derivative at one point, and optimistix chooses the next by their linear model. Where no single
motion fits, or the sum of squares is rugged, the values are those of an ensemble.
"""

import contextlib
import functools
import importlib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._arrays import function, instance, whole
from mjxgrad._programs import compile_once
from mjxgrad.identification.ensemble import Ensemble, fit
from mjxgrad.identification.parameters import Coordinates, Parameter, write_all
from mjxgrad.identification.recording import STATES, Recording, Windows, residuals, spread, stack
from mjxgrad.identification.result import Identification, Stopped, exceeds_noise, on_host, statistics
from mjxgrad.rollouts import DivergedError
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, Discrete

Log = Callable[[int, dict[str, float]], None]
_MOST_REFUSALS = 12  # in a row, which shorten a step by a factor of ten million
_STALLED = 1e-2  # share of the sum of squares that the linear model would remove at the end
_VANISHED = 1e3  # rounding errors of the first residuals: fewer are no misfit
# Norm of the first residuals after scaling: optimistix's first damping, 1, is then about a tenth of JᵀJ.
_FIRST_SIZE = 3.0  # with less, the first step may go too far to recover
_GOOD = 0.75  # share of the predicted fall that lowers the damping; optimistix's 0.99 keeps it too long
# Least gain as a share of the noise variance, and steps in a row below it: badly determined parameters make it creep.
_TOO_LITTLE, _SLOW_STEPS = 1e-3, 3
_LEFT = 0.3  # of the first residuals
_NUM_AWAY, _CLEAR = 5, 1e-10  # points a standard error away; share of the largest curvature that counts
_RUGGED = 10.0  # growth of the sum of squares over what its derivatives foretell
_BETTER, _ALONE = 1.1, 0.5  # the residuals, the sum of squares of one motion, over the ensemble's at most
_MOST_AT_ONCE, _SIDE_BY_SIDE = 256, 64  # motions in one call, and in one batch, for memory
_NEAR_ENOUGH = 1e-3  # of a standard error: shorter steps end the search


def identify(
    scene: Scene,
    parameters: Mapping[str, Parameter],
    recordings: Sequence[Recording],
    *,
    held_out: Sequence[Recording] = (),
    delay: str | None = None,
    free_start: bool | None = None,
    contact: Contact | None = None,
    max_steps: int = 100,
    log: Log | None = None,
) -> Identification:
    r"""Identify parameters of a scene from recorded motions, through contact.

    Minimises $\sum (y_\text{simulated}(\theta) - y_\text{measured})^2 / \text{noise}^2$ by Levenberg-Marquardt with
    derivatives through the simulation. Where contacts chatter, no motion fits: then the mean of many motions is fitted,
    between the bounds, with starts as noisy as they were measured, and the intervals include the chatter. Ctrl-C ends the
    search with the best values so far. Needs optimistix (`pip install 'mjxgrad[identify]'`).

    Args:
        scene: the scene with nominal values.
        parameters: parameters by name, from `mass`, `friction`, `softness` and the like, or a `Parameter` of your own.
        recordings: recordings of the scene.
        held_out: recordings for validation only.
        delay: name of the parameter that delays the controls beyond the recorded times (s); None for no delay.
        free_start: whether the starts are unknown, too. None is for those that are the first row of a recording, as far as it
            was measured, and as noisy; True is for all; with False all are exact.
        contact: as in `rollout`. None is MuJoCo's motion, which recordings by MuJoCo need, for the intervals do not cover the
            error of another one. It is by MJX, but in single precision by C MuJoCo where joints alone were measured, since
            chattering contacts need double precision. `mg.Onset()` is a smoother motion, for recordings of real things.
        max_steps: largest number of simulations with derivatives.
        log: called after each step, or ensemble of motions, as `log(step, {"rms": ..., "is_accepted": ...})`.

    Returns:
        The values, their intervals, and undetermined parameters; `print(result.summary())`.

    Raises:
        ValueError: if there are no parameters or recordings, nothing was measured, or shapes do not fit the scene.
        DivergedError: if the simulation diverges with the nominal values.
        ImportError: if optimistix is not installed.
    """
    if isinstance(recordings, Recording) or not recordings:
        raise ValueError(
            f"recordings must hold at least one, in a list, got {(recordings and 'a recording') or 'none'}"
        )
    instance("parameters", parameters, Mapping, "a dict from names to parameters")
    for part in parameters.values():
        instance("parameters", part, Parameter, "of mg.identification, such as mass(scene, 'torso')")
    instance("scene", scene, Scene, "of mg.load_scene")
    instance("held_out", held_out, Sequence, "a list of recordings")
    for part in (*recordings, *held_out):
        instance("recordings", part, Recording, "of mg.identification.Recording")
    if delay is not None and delay not in parameters:
        raise ValueError(f"delay must name one of the parameters {sorted(parameters)}, got {delay!r}")
    max_steps = whole("max_steps", max_steps)
    function("log", log, "step", "metrics")
    instance("free_start", free_start, bool | None, "True, False or None")
    try:  # before anything is compiled
        importlib.import_module("optimistix")
    except ImportError as error:
        raise ImportError("identify needs optimistix, not installed: pip install 'mjxgrad[identify]'") from error
    if contact is None:
        has_sensors = any(set(one.measured) - set(STATES) for one in (*recordings, *held_out))
        contact = Discrete(None if has_sensors or scene.data.qpos.dtype == np.float64 else "mujoco")
    program = _Program(scene, recordings, parameters, free_start=free_start, delay=delay, contact=contact)
    start = program.start()
    end = _descend(program, start, max_steps, log)
    has_noise = all(one.knows_noise and set(one.noise) == set(one.measured) for one in recordings)
    if end.stopped is Stopped.INTERRUPTED:
        return _identified(program, end, None, held_out, has_noise)
    many = None
    try:
        is_rugged = _ruggedness(program, end) > _RUGGED
        if is_rugged or _is_off(program, end, has_noise):
            many = _ensemble(program, 1.0 if has_noise else None, end.num_steps, log)
            rms = np.linalg.norm(many.residual) / math.sqrt(program.num_numbers)
            is_alone = float(jnp.sum(end.found[0] ** 2)) < _ALONE * many.least or not is_rugged
            if _rms(program, end.found) < _BETTER * rms and is_alone:
                many = None
    except KeyboardInterrupt:
        end = end._replace(stopped=Stopped.INTERRUPTED)
    return _identified(program, end, many, held_out, has_noise)


def _ensemble(program: "_Program", noise: float | None, num_steps: int, log: Log | None) -> Ensemble:
    steps = itertools.count(num_steps + 1)

    def say(rms: float) -> None:
        if log is not None:
            log(next(steps), {"rms": rms, "is_accepted": 1.0})

    box = [np.where(np.isfinite(x), x, sign) for x, sign in zip(program.coordinates.box(), (-1.0, 1.0), strict=True)]
    run = lambda points, draws: program.motions(program.windows, points, draws * program.spread)  # noqa: E731
    return fit(run, (box[0], box[1]), program.spread.shape, program.num_numbers, noise, say)


def _is_off(program: "_Program", end: "_End", has_noise: bool) -> bool:
    """Return whether a descent left more than noise; if that is not known, whether it stalled or explained little."""
    after = _rms(program, end.found)
    if has_noise:
        return exceeds_noise(after, program.num_numbers - len(program.start()))
    rounding = _VANISHED * float(jnp.finfo(end.point.dtype).eps)
    return after > _LEFT * end.first or (end.removable > _STALLED and after > max(rounding, 1e-6) * end.first)


class _End(NamedTuple):
    """The end of a descent: the best point, and how the search came there."""

    point: Array
    found: tuple[Array, ...]  # residuals and their derivatives there
    num_steps: int
    stopped: Stopped
    first: float  # root mean square of the residuals at the start
    removable: float  # share of the sum of squares that the linear model would still remove


def _identified(
    program: "_Program", end: _End, many: Ensemble | None, held_out: Sequence[Recording], has_noise: bool
) -> Identification:
    """Return the values at the end of a search, or of an ensemble, with all that the recordings tell of them."""
    coordinates, numbers = program.coordinates, program.num_numbers
    count, stopped, removable = len(coordinates.names), end.stopped, end.removable
    if many is None:
        point, (residual, slope, num_offsets) = end.point[:count], _without_offsets(*on_host(end.found))
        signals = np.asarray(end.found[0], float)
        if removable > _STALLED and _is_off(program, end, has_noise) and stopped is Stopped.CONVERGED:
            stopped = Stopped.STALLED
    else:
        point, signals, residual, num_offsets = jnp.asarray(many.point), many.residual, many.residual, 0
        slope, removable = many.slope / np.asarray(coordinates.scale, float), 0.0
        stopped = (
            stopped if stopped is Stopped.INTERRUPTED else Stopped.CONVERGED if many.is_settled else Stopped.STALLED
        )
    values = np.asarray(coordinates.values(point.astype(coordinates.nominal.dtype)), float)
    signals = signals.reshape(*program.windows.index.shape, -1)
    verdict = statistics(coordinates, values, residual, slope, numbers, num_offsets)
    verdict["half_width"] = coordinates.unravel(verdict["half_width"])
    nominal = np.asarray(coordinates.nominal, float)
    is_at_bound = coordinates.is_at_bound(jnp.asarray(values, coordinates.nominal.dtype))
    return Identification(
        **verdict,
        values=coordinates.unravel(values),
        start=coordinates.unravel(nominal),
        names=coordinates.names,
        at_bounds=tuple(name for name, at in zip(coordinates.names, is_at_bound, strict=True) if at),
        rms=(end.first, float(np.linalg.norm(residual) / np.sqrt(numbers))),
        has_noise=has_noise,
        held_out_rms=None
        if stopped is Stopped.INTERRUPTED
        else program.held_out_rms(held_out, end.point[:count], many),
        offsets=program.offsets(end.point) if many is None else None,
        correlation=float((signals[:, 1:] * signals[:, :-1]).sum() / ((signals**2).sum() or 1.0)),
        removable=removable,
        num_motions=1 if many is None else len(many.points),
        num_numbers=numbers,
        num_steps=end.num_steps,
        stopped=stopped,
        scene=program.put(program.nominal, jnp.asarray(values, coordinates.nominal.dtype)),
        coordinates=coordinates,
        units={name: parameter.unit for name, parameter in program.parameters.items()},
    )


def _ruggedness(program: "_Program", end: _End) -> float:
    """Return how a standard error away the sum of squares grows, over what its derivatives foretell: 1 where it is smooth."""
    _, residual, slope = (np.asarray(x, float) for x in _linear_model(program, end.found, end.point, 1.0))
    sizes, axes = np.linalg.eigh(slope.T @ slope)
    is_clear, total = sizes > _CLEAR * sizes.max(), float(residual @ residual)
    lengths = np.where(is_clear, np.sqrt(total / program.num_numbers / np.where(is_clear, sizes, 1.0)), 0.0)
    growth = []
    for draw in np.random.default_rng(0).normal(size=(_NUM_AWAY, len(sizes))):
        change = axes @ (lengths * draw)
        there = program(jnp.asarray(end.point + change, end.point.dtype))[0]
        foretold = np.sum((slope @ change) ** 2) + np.finfo(float).tiny
        growth.append((float(jnp.sum(there**2)) - total) / foretold)
    return float(np.median(growth))


class _Program:
    """Residuals and their derivatives by values and offsets. Measurements are arguments, so other data compile nothing."""

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        parameters: Mapping[str, Parameter],
        *,
        free_start: bool | None,
        delay: str | None,
        contact: Contact,
    ):
        self.nominal, self.parameters, self.coordinates = scene, parameters, Coordinates.of(parameters)
        self.free_start, self._delay, self._contact = free_start, delay, contact
        self.spread = spread(scene, recordings, free_start)
        # One unknown for each noisy number of a start, in units of its noise, or for all of them.
        sizes = np.ones_like(self.spread) if free_start else self.spread
        self._free = np.flatnonzero(sizes.any(axis=0))
        self._sizes = jnp.asarray(sizes[:, self._free], self.coordinates.nominal.dtype)
        self.windows = stack(scene, recordings)
        self.num_numbers = _num_numbers(self.windows)
        if not self.num_numbers:
            raise ValueError("recordings must hold something that was measured, got NaN alone")
        self._compiled: dict[Any, jax.stages.Compiled] = {}

    def _run(self, function: Callable, *arguments: Any) -> Any:
        key = function, *(leaf.shape for leaf in jax.tree.leaves(arguments))
        if key not in self._compiled:
            self._compiled[key] = compile_once(jax.jit(function).lower(*arguments))
        return self._compiled[key](*arguments)

    def put(self, scene: Scene, vector: Array) -> Scene:
        """Return the scene with these values."""
        return write_all(scene, self.parameters, self.coordinates.unravel(vector))

    def _residuals(self, vector: Array, offset: Array | None, window: Windows) -> Array:
        scene = self.put(self.nominal, vector)
        delay = None if self._delay is None else self.coordinates.unravel(vector)[self._delay]
        residual, diverged = residuals(scene, window, offset, delay, contact=self._contact)
        return jnp.where(diverged, jnp.inf, residual)

    def _traced(self, windows: Windows, vector: Array, starts: Array, sizes: Array) -> tuple[Array, ...]:
        def one(window: Windows, start: Array, size: Array) -> tuple[Array, ...]:
            def both(vector: Array, start: Array) -> tuple[Array, Array]:
                residual = self._residuals(vector, self._change(start * size), window)
                return residual, residual

            slopes, residual = jax.jacfwd(both, (0, 1) if start.size else (0,), has_aux=True)(vector, start)
            return residual, *slopes

        return jax.vmap(one)(windows, starts, sizes)

    def _change(self, free: Array) -> Array | None:
        """Return the change of a start with these free numbers; None if all starts are known."""
        return jnp.zeros(self.spread.shape[1], free.dtype).at[self._free].set(free) if free.size else None

    def _over_points(self, windows: Windows, points: Array, starts: Array) -> Array:
        def of_one(given: tuple[Array, Array]) -> Array:
            vector = self.coordinates.values(given[0])
            return jax.vmap(lambda window, start: self._residuals(vector, start, window))(windows, given[1])

        return jax.lax.map(of_one, (points, starts), batch_size=_SIDE_BY_SIDE)

    def motions(self, windows: Windows, points: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return the residuals of motions by point, window and number, with changes of the starts."""
        size, dtype, found = min(_MOST_AT_ONCE, len(points)), self.coordinates.nominal.dtype, []
        for begin in range(0, len(points), size):
            parts = [x[begin : begin + size] for x in (points, starts)]
            full = [jnp.asarray(np.pad(x, [(0, size - len(x)), *[(0, 0)] * (x.ndim - 1)]), dtype) for x in parts]
            found.append(np.asarray(self._run(self._over_points, windows, *full), float)[: len(parts[0])])
        return np.concatenate(found)

    def __call__(self, point: Array) -> tuple[Array, ...]:
        vector = self.coordinates.values(point[: len(self.coordinates.names)])
        return self._run(self._traced, self.windows, vector, self._starts(point), self._sizes)

    def start(self) -> Array:
        """Return the point of the nominal values, with starts as they were given: zero."""
        return jnp.zeros(len(self.coordinates.names) + self._sizes.size, self.coordinates.nominal.dtype)

    def box(self) -> tuple[Array, Array]:
        """Return the bounds of a point; starts are unbounded."""
        free = jnp.full(self._sizes.size, jnp.inf)
        lower, upper = self.coordinates.box()
        return jnp.concatenate([lower, -free]), jnp.concatenate([upper, free])

    def _starts(self, point: Array) -> Array:
        return point[len(self.coordinates.names) :].reshape(self._sizes.shape)

    def offsets(self, point: Array) -> np.ndarray | None:
        """Return the changes of the starts at a point, one row per window; None if all starts are known."""
        if not self._sizes.size:
            return None
        return np.asarray(jax.vmap(self._change)(self._starts(point) * self._sizes))

    def held_out_rms(
        self, held_out: Sequence[Recording], point: Array, many: Ensemble | None
    ) -> tuple[float, float] | None:
        """Return the rms residuals of held-out recordings at the nominal values and in the end; None without any."""
        if not held_out:
            return None
        judged, noise = stack(self.nominal, held_out), spread(self.nominal, held_out, self.free_start)
        ends = self.motions(judged, np.stack([np.zeros(len(point)), point]), np.zeros((2, *noise.shape)))
        if many is not None:
            draws = many.noise * np.random.default_rng(1).normal(size=(len(many.points), *noise.shape))
            ends = [ends[0], many.judged(self.motions(judged, many.points, draws * noise))]
        first, last = (float(np.linalg.norm(one) / np.sqrt(_num_numbers(judged))) for one in ends)
        return first, last


def _rms(program: _Program, found: tuple[Array, ...]) -> float:
    return math.sqrt(float(jnp.sum(found[0] ** 2)) / program.num_numbers)


def _num_numbers(windows: Windows) -> int:
    return sum(int((np.asarray(weight) > 0).sum()) for weight in windows.weight.values())


def _descend(program: _Program, point: Array, max_steps: int, log: Log | None) -> _End:
    """Minimise the residuals from a point by Levenberg-Marquardt, until an interruption at most."""
    lower, upper = program.box()
    found = best = program(point)
    first = _rms(program, found)
    if not np.isfinite(first):
        raise DivergedError("nominal values must give motions that stay finite, got one that diverged: begin elsewhere")
    size = (first or 1.0) * math.sqrt(program.num_numbers) / _FIRST_SIZE
    linear = _linear_model(program, found, point, size)
    solver, state = _levenberg_marquardt(*linear[2].shape, point.dtype)
    state = eqx.tree_at(lambda s: s.y_eval, state, point)
    refusals, slow, removable, total = 0, 0, 1.0, math.inf
    end = _End(point, best, 0, Stopped.INTERRUPTED, first, removable)
    with contextlib.suppress(KeyboardInterrupt):
        for count in range(1, max_steps + 1):
            point, state, _ = _step(solver, point, state, linear)
            is_accepted = int(state.num_steps_since_acceptance) == 0
            if is_accepted:
                fell, total = total - float(linear[1] @ linear[1]), float(linear[1] @ linear[1])
                slow = slow + 1 if fell * program.num_numbers < _TOO_LITTLE * total else 0
                best, refusals, removable = found, 0, float(_removable(linear))
            else:
                refusals += 1
            end = _End(point, best, count, Stopped.INTERRUPTED, first, removable)
            if log is not None:
                rms = float(jnp.linalg.norm(linear[1])) / _FIRST_SIZE * first
                log(count, {"rms": rms, "is_accepted": float(is_accepted)})
            is_near = removable * program.num_numbers < _NEAR_ENOUGH**2
            if is_near or bool(state.terminate) or refusals == _MOST_REFUSALS or slow == _SLOW_STEPS:
                return end._replace(stopped=Stopped.CONVERGED)
            state = eqx.tree_at(lambda s: s.y_eval, state, jnp.clip(state.y_eval, lower, upper))
            found = program(state.y_eval)
            linear = _linear_model(program, found, state.y_eval, size)
        return end._replace(stopped=Stopped.STEPS)
    return end


@functools.lru_cache(maxsize=32)
def _levenberg_marquardt(numbers: int, unknowns: int, dtype: Any) -> tuple[Any, Any]:
    """Return optimistix's solver and its state at zero; it sees only linear models.

    The state holds functions of this solver, so a step with the state of another solver would be compiled again.
    """
    optimistix, tolerance = importlib.import_module("optimistix"), float(np.sqrt(jnp.finfo(dtype).eps))
    solver = optimistix.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    solver = eqx.tree_at(lambda s: s.search, solver, optimistix.ClassicalTrustRegion(high_cutoff=_GOOD))
    point, residual = jnp.zeros(unknowns, dtype), jnp.zeros(numbers, dtype)
    linear = (point, residual, jnp.zeros((numbers, unknowns), dtype))
    struct = jax.eval_shape(lambda: residual)
    return solver, solver.init(_predict, point, linear, {}, (struct, None), None, frozenset())


@eqx.filter_jit
def _step(solver: Any, point: Array, state: Any, linear: tuple[Array, Array, Array]) -> tuple[Array, Any, Any]:
    """Return the next point, its state, and further results of optimistix."""
    return solver.step(_predict, point, linear, {}, state, frozenset())


def _predict(point: Array, linear: tuple[Array, Array, Array]) -> tuple[Array, None]:
    """Return the residuals of the linear model; exact at the point where it was made."""
    at, residual, slope = linear
    return residual + slope @ (point - at), None


@jax.jit
def _removable(linear: tuple[Array, Array, Array]) -> Float[Array, ""]:
    """Return the share of the sum of squares that the linear model would remove along clear directions."""
    _, residual, slope = linear
    lengths = jnp.linalg.norm(slope, axis=0)
    columns = slope / jnp.where(lengths > 0, lengths, 1.0)
    sizes, axes = jnp.linalg.eigh(columns.T @ columns)
    along = axes.T @ (columns.T @ residual)
    is_clear = sizes > jnp.sqrt(jnp.finfo(sizes.dtype).eps) * jnp.max(sizes)
    total = jnp.sum(residual**2)
    removed = jnp.sum(jnp.where(is_clear, along**2 / jnp.where(is_clear, sizes, 1.0), 0.0))
    return removed / jnp.where(total > 0, total, 1.0)


def _linear_model(program: _Program, found: tuple[Array, ...], point: Array, size: float) -> tuple[Array, Array, Array]:
    """Return a point, its residuals in units of the first ones, and their derivative by the point."""
    count = len(program.coordinates.names)
    residual, slope = found[0].ravel() / size, found[1].reshape(-1, count) / size
    # A number that the residuals push against its bound stays there; the others move without it.
    lower, upper = (part[:count] for part in program.box())
    gradient = residual @ slope
    is_held = ((point[:count] <= lower) & (gradient > 0)) | ((point[:count] >= upper) & (gradient < 0))
    slope = slope * jnp.where(is_held, 0.0, program.coordinates.scale)
    if len(found) > 2:
        slope = jnp.concatenate([slope, jax.scipy.linalg.block_diag(*found[2]) / size], axis=1)
    return point, residual, slope


def _without_offsets(
    residual: np.ndarray, slope: np.ndarray, by_offset: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return residuals, their derivative by the values orthogonal to the effect of offsets, and the number of offsets."""
    parts, count = list(slope), 0
    for i, of_window in enumerate(() if by_offset is None else by_offset):
        left, sizes, _ = np.linalg.svd(of_window, full_matrices=False)
        left = left[:, sizes > 1e-8 * sizes.max(initial=0.0)]
        parts[i], count = parts[i] - left @ (left.T @ parts[i]), count + left.shape[1]
    return residual.ravel(), np.concatenate(parts), count
