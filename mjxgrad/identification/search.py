r"""The search: residuals of all recordings in one program, their derivative in forward mode, and a trust region.

One program rolls out all windows of a scene under `jax.vmap`, with one tangent per parameter. The unknown start of a window
affects that window alone, so the tangents of the starts do not grow with the number of windows. Each step of the search asks
this program for residuals and derivative at one point, and SciPy chooses the next by their linear model. Where no single
motion fits, or the sum of squares is rugged, the values are those of an ensemble.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special
from jaxtyping import Array, Float

from mjxgrad._arrays import function, instance, whole
from mjxgrad._programs import compile_once
from mjxgrad.engines import QUICK
from mjxgrad.identification.ensemble import Ensemble, fit
from mjxgrad.identification.parameters import Coordinates, Parameter, write_all
from mjxgrad.identification.recording import STATES, Recording, Windows, after_start, residuals, spread, stack
from mjxgrad.identification.result import CHANCE, Identification, Stopped, exceeds_noise, on_host, statistics
from mjxgrad.rollouts import DivergedError
from mjxgrad.scene import Scene
from mjxgrad.stepping import Contact, Discrete

Log = Callable[[int, dict[str, float]], None] | None
_TOO_LITTLE = 1e-3  # gain of a step at the end, of the noise variance
_LEFT, _DOUBT = 0.3, 0.05  # of the first residuals; chance of noise alone, below which better values are sought
_NUM_AWAY, _CLEAR = 5, 1e-10  # points a standard error away; share of the largest curvature that counts
_RUGGED = 10.0  # growth of the sum of squares over what its derivatives foretell
_BETTER = 1.1  # residuals of one motion over the ensemble's at most
_SHORT, _AGREE = 10, 4  # steps of a descent from a motion that nearly fits; ends alike at which no better one is sought
_MOST_AT_ONCE, _SIDE_BY_SIDE = 256, 64  # motions in one call, and in one batch, for memory


class _End(NamedTuple):
    """The end of a descent: the best point, and how the search came there."""

    point: Array
    found: tuple[Array, ...]  # residuals and their derivatives there
    num_steps: int
    stopped: Stopped
    first: float  # root mean square of the residuals at the start
    away: Float[np.ndarray, "dim dim"] | float = 0.0  # second moment of the distances to other ends


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
    log: Log = None,
) -> Identification:
    r"""Identify parameters of a scene from recorded motions, through contact.

    Minimises $\sum (y_\text{simulated}(\theta) - y_\text{measured})^2 / \text{noise}^2$ by a trust region with
    derivatives through the simulation. Where contacts chatter, no motion fits: then the mean of many motions is fitted,
    between the bounds, with starts as noisy as they were measured, and the intervals include the chatter. Ctrl-C ends the
    search with the best values so far.

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
        max_steps: largest number of simulations with derivatives; those of many motions without are not counted.
        log: called after each step, or ensemble of motions, as `log(step, {"rms": ..., "is_accepted": ...})`.

    Returns:
        The values, their intervals, and undetermined parameters; `print(result.summary())`.

    Raises:
        ValueError: if there are no parameters or recordings, nothing was measured, or shapes do not fit the scene.
        DivergedError: if the simulation diverges with the nominal values.
    """
    if isinstance(recordings, Recording) or not recordings:
        given = "a recording" if isinstance(recordings, Recording) else "none"
        raise ValueError(f"recordings must hold at least one, in a list, got {given}")
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
    if contact is None:
        has_sensors = any(set(one.measured) - set(STATES) for one in (*recordings, *held_out))
        contact = Discrete()
        scene = scene if has_sensors or scene.data.qpos.dtype == np.float64 else scene.with_engine(QUICK)
    program = _Program(scene, recordings, parameters, free_start=free_start, delay=delay, contact=contact)
    steps = itertools.count(1)
    end = _descend(program, program.start(), steps, max_steps, log)
    has_noise = all(one.knows_noise and set(one.noise) == set(one.measured) for one in recordings)
    if end.stopped is Stopped.INTERRUPTED:
        return _identified(program, end, None, held_out, has_noise)
    many, noise = None, 1.0 if has_noise else None
    try:
        is_rugged = _ruggedness(program, end) > _RUGGED
        if is_rugged or _is_off(program, end, noise, _DOUBT):
            many = _ensemble(program, noise, steps, log)
            end = _alone(program, end, many, steps, max_steps, log)
            rms = np.linalg.norm(many.residual) / math.sqrt(program.num_numbers)
            residual, slope, _ = _without_offsets(*on_host(end.found))
            told = _told(residual, slope * np.asarray(program.coordinates.scale), np.finfo(float).tiny)
            if _is_off(program, end, many.noise):
                many = None if not is_rugged and _rms(program, end.found) < _BETTER * rms else many
            elif told > _told(many.residual, many.slope, many.noise**2):
                many, end = None, end._replace(stopped=Stopped.CONVERGED)
    except KeyboardInterrupt:
        end = end._replace(stopped=Stopped.INTERRUPTED)
    except DivergedError:  # most motions between the bounds
        end = end._replace(stopped=Stopped.STALLED)
    end = end._replace(num_steps=next(steps) - 1)
    return _identified(program, end, many, held_out, has_noise)


def _ensemble(program: "_Program", noise: float | None, steps: Iterator[int], log: Log) -> Ensemble:
    def say(rms: float) -> None:
        step = next(steps)
        if log is not None:
            log(step, {"rms": rms, "is_accepted": 1.0})

    windows = after_start(program.windows, program.spread)
    box = [np.where(np.isfinite(x), x, sign) for x, sign in zip(program.coordinates.box(), (-1.0, 1.0), strict=True)]
    run = lambda points, draws: program.motions(windows, points, draws * program.spread)  # noqa: E731
    return fit(run, (box[0], box[1]), program.spread.shape, _num_numbers(windows), noise, say)


def _alone(program: "_Program", end: _End, many: Ensemble, steps: Iterator[int], max_steps: int, log: Log) -> _End:
    """Return the best end of descents from the motions that fit best.

    The sum of squares has many minima, by noisy starts or by chatter. Others' distances, weighed by likelihood, are what the
    covariance about one of them lacks.
    """
    ends, count = [end], len(program.coordinates.names)
    total = lambda one: float(jnp.sum(one.found[0] ** 2)) / many.noise**2  # noqa: E731
    for values, starts in many.alone:
        squares, left = [total(one) for one in ends], max_steps - sum(one.num_steps for one in ends)
        if left < 1 or sum(one < min(squares) + 1 for one in squares) >= _AGREE:
            break
        with contextlib.suppress(DivergedError):
            ends.append(_descend(program, program.point(values, starts), steps, min(left, _SHORT), log))
        if ends[-1].stopped is Stopped.INTERRUPTED:
            raise KeyboardInterrupt
    _, first = np.unique(np.round([total(one) for one in ends], 1), return_index=True)  # the best one first
    ends = [ends[i] for i in first]
    values = np.stack([np.asarray(program.coordinates.values(one.point[:count]), float) for one in ends])
    weights = scipy.special.softmax([-total(one) / 2 for one in ends])
    away = values - values[0]
    return ends[0]._replace(first=end.first, stopped=end.stopped, away=np.einsum("k,ki,kj->ij", weights, away, away))


def _told(residual: np.ndarray, slope: np.ndarray, least: float) -> float:
    """Return the logarithm of the determinant of the information on the values, by a variance of the noise of this at least."""
    return float(np.linalg.slogdet(slope.T @ slope / max(np.mean(residual**2), least))[1])


def _is_off(program: "_Program", end: _End, noise: float | None, chance: float = CHANCE) -> bool:
    """Return whether a descent left more than noise has by chance; if that is not known, whether it explained little."""
    after = _rms(program, end.found)
    if noise:
        return exceeds_noise(after / noise, program.num_numbers - len(program.start()), chance)
    return after > _LEFT * end.first


def _identified(
    program: "_Program", end: _End, many: Ensemble | None, held_out: Sequence[Recording], has_noise: bool
) -> Identification:
    """Return the values at the end of a search, or of an ensemble, with all that the recordings tell of them."""
    coordinates, numbers = program.coordinates, program.num_numbers
    count, stopped = len(coordinates.names), end.stopped
    if many is None:
        point, (residual, slope, num_offsets) = end.point[:count], _without_offsets(*on_host(end.found))
        signals = np.asarray(end.found[0], float)
    else:
        point, signals, residual, num_offsets = jnp.asarray(many.point), many.residual, many.residual, 0
        slope = many.slope / np.asarray(coordinates.scale, float)
        if stopped is not Stopped.INTERRUPTED:
            stopped = Stopped.CONVERGED if many.is_settled else Stopped.STALLED
    values = np.asarray(coordinates.values(point.astype(coordinates.nominal.dtype)), float)
    signals = signals.reshape(*program.windows.index.shape, -1)
    verdict = statistics(coordinates, values, residual, slope, numbers, num_offsets, end.away)
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
        held_out_rms=None if stopped is Stopped.INTERRUPTED else program.held_out_rms(held_out, end.point, many),
        offsets=program.offsets(end.point) if many is None else None,
        correlation=float((signals[:, 1:] * signals[:, :-1]).sum() / ((signals**2).sum() or 1.0)),
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
    residual, slope = _linear_model(program, end.found)
    sizes, axes = np.linalg.eigh(slope.T @ slope)
    is_clear, total = sizes > _CLEAR * sizes.max(), float(residual @ residual)
    lengths = np.where(is_clear, np.sqrt(total / program.num_numbers / np.where(is_clear, sizes, 1.0)), 0.0)
    growth = []
    for draw in np.random.default_rng(0).normal(size=(_NUM_AWAY, len(sizes))):
        change = axes @ (lengths * draw)
        there = program(jnp.asarray(end.point + change, end.point.dtype))[0]
        foretold = np.sum((slope @ change) ** 2) + np.finfo(float).tiny
        growth.append(abs(float(jnp.sum(there**2)) - total) / foretold)
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

    def point(self, values: np.ndarray, starts: np.ndarray) -> Array:
        """Return the point of these coordinates, and of changes of the starts in units of their noise."""
        free = (starts * self.spread)[:, self._free] / np.where(self._sizes > 0, self._sizes, 1.0)
        return jnp.asarray(np.concatenate([values, free.ravel()]), self.coordinates.nominal.dtype)

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
        noise = spread(self.nominal, held_out, self.free_start)
        judged, count = after_start(stack(self.nominal, held_out), noise), len(self.coordinates.names)
        starts, found = np.zeros((2, *noise.shape)), self.offsets(point)
        if many is None and found is not None:  # the end of a recording has the start that was found for its beginning
            begins, known = (np.hstack([one.state.qpos, one.state.qvel]) for one in (judged, self.windows))
            is_same = np.all(begins[:, None] == known, axis=2) & noise.any(axis=1, keepdims=True)
            starts[1] = np.where(is_same.any(axis=1)[:, None], found[is_same.argmax(axis=1)], 0.0)
        ends = self.motions(judged, np.stack([np.zeros(count), point[:count]]), starts)
        if many is not None:
            draws = many.noise * np.random.default_rng(1).normal(size=(len(many.points), *noise.shape))
            ends = [ends[0], many.judged(self.motions(judged, many.points, draws * noise))]
        first, last = (float(np.linalg.norm(one) / np.sqrt(_num_numbers(judged))) for one in ends)
        return first, last


def _rms(program: _Program, found: tuple[Array, ...]) -> float:
    return math.sqrt(float(jnp.sum(found[0] ** 2)) / program.num_numbers)


def _num_numbers(windows: Windows) -> int:
    return sum(int((np.asarray(weight) > 0).sum()) for weight in windows.weight.values())


def _descend(program: _Program, point: Array, steps: Iterator[int], max_steps: int, log: Log) -> _End:
    """Minimise the residuals from a point, until an interruption at most."""
    tolerance = float(np.sqrt(jnp.finfo(point.dtype).eps))
    end = best = _End(point, program(point), 0, Stopped.INTERRUPTED, 0.0)
    first = _rms(program, best.found)
    if not np.isfinite(first):
        raise DivergedError("nominal values must give motions that stay finite, got one that diverged: begin elsewhere")
    size, triangles = (first or 1.0) * math.sqrt(program.num_numbers), {}

    def triangle(at: np.ndarray) -> np.ndarray:
        """Return the triangular factor of derivative and residual, which has their products and few rows."""
        nonlocal end, best
        if (key := at.tobytes()) not in triangles:
            triangles.clear()
            point = jnp.asarray(at, best.point.dtype)
            found = best.found if not best.num_steps else program(point)
            end = _End(point, found, end.num_steps + 1, Stopped.INTERRUPTED, first)
            rms = _rms(program, found)
            is_better = not best.num_steps or rms < _rms(program, best.found)
            best = end if is_better else best
            step = next(steps)
            if log is not None:
                log(step, {"rms": rms, "is_accepted": float(is_better)})
            residual, slope = _linear_model(program, found)
            is_finite = np.isfinite(residual).all() and np.isfinite(slope).all()
            factor = np.linalg.qr(np.column_stack([slope, residual]) / size, mode="r") if is_finite else np.inf
            triangles[key] = np.broadcast_to(factor, (min(len(residual), len(at) + 1), len(at) + 1))
        return triangles[key]

    of, by = (lambda at: triangle(at)[:, -1]), (lambda at: triangle(at)[:, :-1])
    settings: dict[str, Any] = {"ftol": _TOO_LITTLE / program.num_numbers, "xtol": tolerance, "gtol": None, "jac": by}
    bounds = tuple(np.asarray(part, float) for part in program.box())
    with contextlib.suppress(KeyboardInterrupt):
        done = scipy.optimize.least_squares(of, np.asarray(point, float), bounds=bounds, max_nfev=max_steps, **settings)
        best = best._replace(stopped=Stopped.CONVERGED if done.status else Stopped.STEPS)
    return best._replace(num_steps=end.num_steps)


def _linear_model(program: _Program, found: tuple[Array, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals and their derivative by the point."""
    residual, slope, *by_start = on_host(found)
    blocks: list[Any] = [scipy.linalg.block_diag(*part) for part in by_start]
    slope = slope.reshape(residual.size, -1) * np.asarray(program.coordinates.scale, float)
    return residual.ravel(), np.column_stack([slope, *blocks])


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
