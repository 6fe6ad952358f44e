"""Measurements of a scene's derivatives, along lines and under noise, by the library's diagnostics."""

import contextlib
import functools
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from mjxgrad._arrays import whole
from mjxgrad._interrupts import patiently
from mjxgrad._text import format_number
from mjxgrad.checking.motions import (
    KINDS,
    REFINED,
    Direction,
    Kind,
    Motions,
    Moved,
    Mover,
    half_range,
    moved,
    pairs_at,
    smooth,
)
from mjxgrad.contact import Softness
from mjxgrad.diagnostics.jumps import Jumps, jumps_along
from mjxgrad.diagnostics.slope import SlopeComparison, compare_to_slope, phases
from mjxgrad.rollouts import State, initial_state, rollout
from mjxgrad.scene import Scene, SceneError
from mjxgrad.stepping import Discrete, EngineName

_TEETH = 6  # number of time steps by which the first touch moves from the middle of a line to its end
_SPEED_SHARE, _CONTROL_SHARE = 0.2, 0.2  # share of the approach speed, and of half the control range
_WIDE = 4.0  # relative length of the last line, which finds more distant jumps
STDDEVS = (0.1, 0.3)
"""Noise levels, as a share of half the range of controls; without controls, of the initial velocities (m/s, rad/s)."""
SOFTER = 0.1
"""Softer stiffness to compare with the file's, as a share of it."""
_NUM_LINES, _NUM_TIMES = 3, 4
_BEFORE, AFTER = 30, 40
"""Steps around the first touch."""
_FEWEST_STEPS, _MOST_STEPS, _TRIED_STEPS = 40, 300, 8
_FEWEST_MOTIONS = 8  # of a batch whose derivatives are taken, which take most of the time
_SHARE = 0.6  # of the time that is left, for the slopes of a line or of noise
_SMALLEST_JUMP = 0.05  # share of the outcome's variation along the line
_CLEAR = 0.1  # largest relative error of a usable slope
_FEWEST_TEETH = 4
CLOSE = 0.05
"""Largest expected error of a derivative that counts as the slope."""
FEWEST_READINGS = 4
"""Fewest readings that tell which derivative is nearer."""
_MOST_UNMEASURED = 4.0  # times the price of a discrete derivative, up to which a slope is taken unmeasured
_AT_REST = 1e-3  # share of the largest variation at any time
_UNFELT = 1e-6  # share of the largest spread of all outcomes, or of 10⁻⁶: less is rounding
NUM_COMPARED, STEPS_COMPARED = 256, 20
"""Gradients side by side, and their steps, by which engines are compared."""
_BESIDE = 0.05  # share of half a line beyond the jumps, where touching pairs are compared
_REFINEMENTS = 2  # a rise within 1/5000 of the line is a jump: a hundred samples would miss it


@dataclass(frozen=True)
class Line:
    """Motions along a line through one of the random motions."""

    pose: str  # name of the initial pose
    varied: str  # description of the change along the line
    plain: SlopeComparison  # slope and derivatives of MuJoCo's motion, by kind
    fine: SlopeComparison  # slope of the motion at a much shorter time step, beside the same derivatives
    jumps: Jumps  # jumps of the fine motion, over its spread; the parameter is the place on the line
    changed: tuple[str, ...]  # pairs that touch only on one side of the jumps
    growth: Float[np.ndarray, " times"]  # growth of a change of the start, by time; NaN where only controls are changed
    num_diverged: int  # number of motions that diverged


@dataclass(frozen=True)
class Noise:
    """Both estimates of the derivative along one direction, with noise on all controls or initial velocities."""

    stddev: float  # standard deviation, see `STDDEVS`
    stiffness: float | None  # stiffness of all contacts in 1/s²; None is the file's
    first: Float[np.ndarray, "some times outcomes"]  # first-order estimates by single motions
    zeroth: Float[np.ndarray, "motions times outcomes"]  # zeroth-order estimates by these and more motions
    crossover: float  # the time from which zeroth order is at least as good, in s

    @property
    def advantage(self) -> float:
        """The ratio of samples that zeroth and first order need at the last time, as the median over outcomes."""
        first, zeroth = (one[:, -1].var(axis=0) for one in (self.first, self.zeroth))
        is_felt = zeroth > _UNFELT**2 * np.nanmax(zeroth, initial=0.0)
        ratios = zeroth[is_felt] / np.maximum(first[is_felt], 1e-12 * zeroth[is_felt])
        return float(np.median(ratios)) if ratios.size else np.nan


@dataclass(frozen=True)
class Slope:
    """Relative errors of one kind of derivative at all readings, 1 at most, and from how many motions a line its mean is."""

    kind: Kind
    errors: Float[np.ndarray, " readings"]
    num_motions: int

    @property
    def error(self) -> float:
        """The error to expect: the mean, with what the scatter of single motions adds."""
        return float(self.errors.mean()) if self.errors.size else np.nan


def slopes(lines: Sequence[Line]) -> tuple[Slope, ...]:
    """Return the errors of each derivative over all lines, times and outcomes with a clear slope."""
    found = []
    for kind in KINDS:
        errors, counts = [np.zeros(0)], [0]
        for line in lines:
            comparison = line.plain
            at = comparison.gradients.index(kind)
            # An outcome with hardly a tooth has the slope of that tooth: then only the slope at the shorter step counts.
            is_told = comparison.num_teeth >= _FEWEST_TEETH
            truths = [line.fine.slope, np.where(is_told, comparison.slope, line.fine.slope)]
            spread = np.where(is_told, np.maximum(comparison.slope_error, line.fine.slope_error), line.fine.slope_error)
            size = np.abs(line.fine.slope)
            is_clear = (size > line.fine.resolution) & (spread <= np.maximum(_CLEAR * size, line.fine.resolution))
            mean = comparison.mean[at]
            off_by = np.maximum(np.min(truths, axis=0) - mean, mean - np.max(truths, axis=0))
            off_by = np.maximum(off_by, comparison.mean_error[at])  # luck is no merit
            share = np.nan_to_num(off_by / np.maximum(size, line.fine.resolution), nan=1.0)
            counts.append(int(np.isfinite(comparison.derivatives[at]).all(axis=(1, 2)).sum()))
            errors.append(np.minimum(share, 1.0)[is_clear])
        found.append(Slope(kind, np.concatenate(errors), max(counts)))
    return tuple(found)


def unmeasured(price: int | float) -> Kind:
    """Return the derivative to take where nothing speaks against the slope but its price; infinity is one that is not known."""
    return "discrete" if _MOST_UNMEASURED < price < math.inf else "slope"


def nearest(found: Sequence[Slope], price: int | float = np.inf) -> Kind:
    """Return the derivative to take: the slope, at a price in that of the discrete one, or that where it is as near.

    A mean square would count a few readings alone, and how many are right within their errors would reward scatter.
    """
    slope, discrete = found
    gains = discrete.errors - slope.errors
    if gains.size and (discrete.error <= CLOSE or gains.mean() <= 0):
        return "discrete"
    if gains.size < FEWEST_READINGS:
        return unmeasured(price)
    # In standard errors: a slope of four times the price or more must be nearer by two. A bias costs more than time does.
    needed = 1.0 if not np.isfinite(price) else np.clip(np.log2(price), 0.0, 2.0)
    return "slope" if gains.mean() > needed * gains.std() / np.sqrt(gains.size) else "discrete"


def seconds_by_engine(
    scene: Scene, engines: Iterable[EngineName], say: Callable[[str], None]
) -> dict[EngineName, tuple[float, float]]:
    """Return how long the first and a later call of many discrete gradients take, by each engine that steps the scene."""
    found: dict[EngineName, tuple[float, float]] = {}
    home, nu = jnp.asarray(scene.data.ctrl), scene.model.nu
    draws = jax.random.normal(jax.random.key(0), (NUM_COMPARED, STEPS_COMPARED, nu), home.dtype)
    controls = home + 0.1 * jnp.asarray(half_range(scene), home.dtype) * draws

    def gradients(stepped: Scene) -> Callable:
        ends = lambda c: rollout(stepped, initial_state(stepped), c, contact=Discrete()).qpos[-1].sum()  # noqa: E731
        return jax.jit(jax.vmap(jax.grad(ends)))

    for engine in engines:
        say(f"measuring {NUM_COMPARED} gradients by {engine}, which may compile for a minute or more; Ctrl-C ends it")
        try:
            compute, began = gradients(scene.with_engine(engine)), time.perf_counter()
            patiently(lambda compute=compute: jax.block_until_ready(compute(controls)))
            first, again = time.perf_counter() - began, time.perf_counter()
            patiently(lambda compute=compute: jax.block_until_ready(compute(controls + 0)))
            found[engine] = first, time.perf_counter() - again
        except SceneError:  # it does not step this scene
            continue
        except KeyboardInterrupt:
            break
    return found


@dataclass(frozen=True)
class Measured:
    """All measurements, and the names of those left out for lack of time; times of outcomes after the start, in s."""

    times: Float[np.ndarray, " times"]
    lines: tuple[Line, ...]
    noises: tuple[Noise, ...]
    left_out: tuple[str, ...] = ()
    was_interrupted: bool = False
    windows: tuple[tuple[int, int], ...] = ()  # of each line its motion, and the step of this with which it begins


def measure(
    scene: Scene,
    motions: Motions,
    mover: Mover,
    rng: Generator,
    *,
    from_start: bool,
    seconds: int | float,
    log: Callable[[str], None],
    horizon: int | None = None,
) -> Measured:
    """Measure along lines and under noise within a budget in seconds, and leave out the rest; without a horizon, choose it."""
    order = sorted(np.flatnonzero(motions.bad_steps < 0).tolist(), key=lambda i: motions.onsets[i] < 0)
    begins = [0 if from_start else max(0, int(motions.onsets[i]) - _BEFORE) for i in order]
    onsets = [int(motions.onsets[i]) - begin for i, begin in zip(order, begins, strict=True)]
    mover.is_needed = True
    lengths = patiently(lambda: _lengths(mover, motions, order[0], begins[0], onsets, seconds, horizon))
    num_steps = lengths[-1]
    # A motion with a late first touch starts shortly before it.
    begins = [min(begin, motions.controls.shape[1] - num_steps) for begin in begins]
    log(f"derivatives over {num_steps} steps, {num_steps * motions.timestep:.3g} s, from motions that touch")
    probe = _Probe(scene, motions, mover, lengths)
    chosen = [(order[i % len(order)], begins[i % len(order)]) for i in range(_NUM_LINES)]
    directions = [_direction(scene, rng, num_steps, motions.touch_speed or 1.0, i) for i in range(_NUM_LINES)]
    softer = [SOFTER * float(np.median(np.asarray(scene.contact_parameters().stiffness)))] if scene.pairs else []
    lines, windows, noises, left_out, end = [], [], [], [], mover.end

    def line(*task: Any) -> None:
        lines.append(probe.line(*task))
        windows.append(task[:2])

    def noise(stddev: float, stiffness: float | None, own_rng: Generator) -> None:
        noises.append(probe.noise(*chosen[0], stddev, stiffness, own_rng, nearest(slopes(lines))))

    both = zip(chosen, directions, strict=True)
    asked: list[tuple[str, Callable, tuple]] = [(f"a line along {one[0]}", line, (*at, *one)) for at, one in both]
    for stddev, stiffness in [(stddev, soft) for soft in [None, *softer] for stddev in STDDEVS]:
        words = "" if stiffness is None else f" with contacts at {format_number(stiffness)} 1/s²"
        own_rng = np.random.default_rng(int(rng.integers(2**31)))
        asked.append((f"noise of {stddev:g}{words}", noise, (stddev, stiffness, own_rng)))
    # In order of importance, since the last are left out where time is short: a line, noise, then the others.
    asked.insert(1, asked.pop(_NUM_LINES))
    # One after the other: two at once deadlocked on dm_control's humanoid (two cores, jax 0.10.2).
    for number, (words, measure_one, task) in enumerate(asked):
        # There is a verdict in any case: of a line, and its slope by the fewest motions.
        mover.end, mover.is_needed = end, number == 0
        try:
            patiently(functools.partial(measure_one, *task))
            errors = (f"{one.kind} {one.error:.1%} off" for one in slopes(lines) if one.errors.size)
            log("; ".join([f"{number + 1} of {len(asked)}: {words}", *errors]))
        except TimeoutError:
            left_out.append(words)
        except KeyboardInterrupt:
            log("interrupted: the verdict is of what was measured")
            left_out.append(words)
            end = 0.0
    times, found = np.array(lengths) * motions.timestep, map(tuple, (lines, noises, left_out))
    return Measured(times, *found, was_interrupted=end == 0.0, windows=tuple(windows))


def checked_horizon(horizon: int | None, motions: Motions) -> int | None:
    """Return a number of steps over which these motions can be measured; refuse others."""
    most = motions.controls.shape[1]
    if horizon is not None and whole("horizon", horizon, _NUM_TIMES) > most:
        raise ValueError(f"horizon must be at most {most}, the time steps of the random motions, got {horizon}")
    return horizon


def _lengths(
    mover: Mover,
    motions: Motions,
    motion: int,
    begin: int,
    onsets: list[int],
    seconds: int | float,
    horizon: int | None,
) -> list[int]:
    """Return the steps at which to look; without a horizon, choose the last by first touches and the time of steps about one."""
    wanted = max([onset for onset in onsets if onset >= 0], default=0) + AFTER
    still, size = np.zeros(motions.qvel.shape[2]), _FEWEST_MOTIONS
    direction = Direction(still, still, np.zeros((_TRIED_STEPS, motions.controls.shape[2])))
    begin = max(0, min(begin + _BEFORE, motions.controls.shape[1]) - _TRIED_STEPS // 2)
    states = _repeated(motions.state(motion, begin), size)
    controls = np.repeat(motions.controls[motion, None, begin : begin + _TRIED_STEPS], size, axis=0)
    for _ in range(2):
        mover.move("slope", states, controls, direction, [controls.shape[1]])
    affordable = seconds / max(4 * mover.seconds("slope", mover.size), 1e-9)
    usual = int(np.clip(min(wanted, affordable), _FEWEST_STEPS, min(_MOST_STEPS, motions.controls.shape[1])))
    num_steps = horizon or usual
    return sorted({max(1, round(num_steps * i / _NUM_TIMES)) for i in range(1, _NUM_TIMES + 1)})


def _repeated(state: State, size: int) -> State:
    return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], size, axis=0), state)


def _direction(scene: Scene, rng: Generator, num_steps: int, speed: float, number: int) -> tuple[str, Direction]:
    """Draw a change of the start, of the controls, or a wide one of both; the first touch moves through several teeth."""
    model, timestep = scene.model, float(scene.model.opt.timestep)
    units = rng.normal(size=model.nv), rng.normal(size=model.nv), smooth(rng, num_steps, model.nu, timestep)
    sizes = _TEETH * timestep * speed, _SPEED_SHARE * speed, _CONTROL_SHARE * half_range(scene)
    both = zip(sizes, units, strict=True)
    parts = [size * unit / np.sqrt((unit**2).mean()) if unit.size else unit for size, unit in both]
    wide = _WIDE if number == _NUM_LINES - 1 else 1.0
    has_start, has_controls = number != 1 or not model.nu, number != 0 and model.nu > 0
    # Positions stay narrow: wide ones would begin in penetration.
    given = (1.0 * has_start, wide * has_start, wide * has_controls)
    words = ["the start"] * has_start + ["the controls"] * has_controls
    return " and ".join(words), Direction(*(part * share for part, share in zip(parts, given, strict=True)))


@dataclass(frozen=True)
class _Probe:
    scene: Scene
    motions: Motions
    mover: Mover
    lengths: Sequence[int]

    def _at(self, motion: int, begin: int) -> tuple[State, Float[np.ndarray, "steps nu"]]:
        return self.motions.state(motion, begin), self.motions.controls[motion, begin : begin + self.lengths[-1]]

    def line(self, motion: int, begin: int, words: str, direction: Direction) -> Line:
        """Measure slope, derivatives and jumps along a line."""
        state, controls = self._at(motion, begin)

        def along(kind: Kind, places: Float[np.ndarray, " motions"]) -> Moved:
            states = _repeated(state, len(places))
            states.qpos[:] = moved(self.scene.mj_model, states.qpos, direction.positions, places)
            states.qvel[:] += places[:, None] * direction.velocities
            varied = controls + places[:, None, None] * direction.controls
            return self.mover.move(kind, states, varied, direction, self.lengths)

        places = phases((-1.0, 1.0), self.mover.size)
        own, fine = along("plain", places), along("fine", places)
        slope, discrete = self._in_time(along, KINDS, places)
        self.mover.is_needed = False
        spreads = np.nanstd(own.outcomes, axis=0)
        is_felt = spreads > _UNFELT * np.nanmax(spreads, initial=_UNFELT)
        own, fine = own.where(is_felt), fine.where(is_felt)
        # Both are seen at the same motions.
        derivatives = [slope.derivatives, np.where(np.isnan(slope.derivatives), np.nan, discrete.derivatives)]
        plain, shorter = (compare_to_slope(places, one.outcomes, derivatives, KINDS) for one in (own, fine))
        centre = np.nanmean(fine.outcomes[:, -1], axis=0)
        # Outcomes at rest vary by rounding alone.
        moves_start = direction.positions.any() or direction.velocities.any()
        is_moving = is_felt[-1] & (spreads[-1] > _AT_REST * spreads.max(axis=0))
        scale = np.where(is_moving, spreads[-1], np.inf)
        ends = lambda x: (along("fine", x).outcomes[:, -1] - centre) / scale  # noqa: E731
        sizes = {"num_points": self.mover.size, "num_candidates": self.mover.size // 8, "num_refinements": _REFINEMENTS}
        jumps = Jumps(*[np.zeros(0)] * 3)
        with contextlib.suppress(TimeoutError):  # what is known of slopes is told all the same
            jumps = jumps_along(ends, (-1.0, 1.0), **sizes, smallest=_SMALLEST_JUMP)
        pose = self.motions.poses[motion] + (f", {begin * self.motions.timestep:.3g} s on" if begin else "")
        changed = self._changed(state, controls, direction, jumps)
        growth = np.nanmedian(slope.growth, axis=0) if moves_start else np.full(len(self.lengths), np.nan)
        return Line(pose, words, plain, shorter, jumps, changed, growth, own.num_diverged + fine.num_diverged)

    def _in_time(self, move: Callable[..., Moved], kinds: Sequence[Kind], values: np.ndarray) -> list[Moved]:
        """Move as many values of a batch, evenly spread, as there is time for by each kind, at least 8; the others are NaN."""
        left = _SHARE * max(self.mover.end - time.perf_counter(), 1e-9)
        needed, most = self.mover.seconds("slope", self.lengths[-1] * len(values)), len(values) // _FEWEST_MOTIONS
        stride = math.ceil(min(most, needed / left)) or 1

        def spread(x: np.ndarray) -> np.ndarray:
            (found := np.full((len(values), *x.shape[1:]), np.nan))[::stride] = x
            return found

        parts = [move(kind, values[::stride]) for kind in kinds]
        return [Moved(spread(x.outcomes), spread(x.derivatives), spread(x.growth), x.num_diverged) for x in parts]

    def _changed(self, state: State, controls: np.ndarray, direction: Direction, jumps: Jumps) -> tuple[str, ...]:
        """Return the pairs that touch only on one side of the jumps; a glancing hit jumps once per time step."""
        if jumps.largest < 0:
            return ()
        sides = []
        for x in (jumps.places.min() - _BESIDE, jumps.places.max() + _BESIDE):
            qpos = jnp.asarray(moved(self.scene.mj_model, np.asarray(state.qpos)[None], direction.positions, x)[0])
            start = State(qpos, state.qvel + x * direction.velocities, state.act, state.time, state.warmstart)
            sides.append(pairs_at(self.scene, start, controls + x * direction.controls, REFINED))
        return tuple(sorted(sides[0] ^ sides[1]))

    def noise(
        self, motion: int, begin: int, stddev: float, stiffness: float | None, rng: Generator, kind: Kind
    ) -> Noise:
        """Estimate one derivative by both orders, with noise on all controls (or the initial velocities)."""
        state, controls = self._at(motion, begin)
        half, timestep, still = half_range(self.scene), self.motions.timestep, np.zeros(state.qvel.size)
        has_controls = half.size > 0
        wiggle = smooth(rng, len(controls), len(half), timestep) if has_controls else rng.normal(size=(1, still.size))
        along = wiggle / np.sqrt((wiggle**2).sum())
        noise = stddev * rng.normal(size=(self.mover.size, *along.shape))
        direction = Direction(still, still, along * half) if has_controls else Direction(still, along[0], controls)
        softness = None if stiffness is None else Softness(stiffness=stiffness, damping_ratio=1.0)

        def under(kind: Kind, noise: np.ndarray) -> Moved:
            states, noisy = _repeated(state, len(noise)), np.repeat(controls[None], len(noise), axis=0)
            if has_controls:
                noisy = noisy + noise * half
            else:
                states.qvel[:] += noise[:, 0]
            return self.mover.move(kind, states, noisy, direction, self.lengths, softness)

        found = under("discrete", noise)
        derivatives = found.derivatives
        if kind == "slope":
            derivatives = self._in_time(under, [kind], noise)[0].derivatives
        # An outcome depends only on the noise of earlier steps.
        scores = np.cumsum((noise * along).sum(axis=2), axis=1) / stddev**2
        scores = scores[:, [min(length, len(along)) - 1 for length in self.lengths]]
        first, zeroth = estimates(found.outcomes, derivatives, scores[:, :, None])
        times = np.array(self.lengths) * timestep
        return Noise(stddev, stiffness, first, zeroth, crossover(times, first, zeroth))


def estimates(costs: np.ndarray, derivatives: np.ndarray, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return single estimates of first and zeroth order by motion, time and outcome, of finite motions; NaN of fewer than two."""
    is_finite = np.isfinite(costs).all(axis=(1, 2))
    is_known = is_finite & np.isfinite(derivatives).all(axis=(1, 2))
    if is_known.sum() < 2:
        return np.full_like(costs[:2], np.nan), np.full_like(costs[:2], np.nan)
    costs, scores = costs[is_finite], scores[is_finite]
    # The baseline leaves the motion itself out.
    baselines = (costs.sum(axis=0) - costs) / (len(costs) - 1)
    return derivatives[is_known], (costs - baselines) * scores


def crossover(times: np.ndarray, first: np.ndarray, zeroth: np.ndarray) -> float:
    """Return the time from which zeroth-order samples are as accurate for good, infinite for none; outcomes count alike."""
    if np.isnan(first).any():
        return float(times[0])
    squares = [((one - zeroth.mean(axis=0)) ** 2).mean(axis=0) for one in (first, zeroth)]
    weight = np.where(squares[1] > _UNFELT**2 * squares[1].max(), squares[1], np.inf)
    tiny = np.finfo(float).tiny  # two errors of zero are equal
    of_first, of_zeroth = (np.log(np.maximum((square / weight).sum(axis=1), tiny)) for square in squares)
    log_ratio = of_first - of_zeroth
    if not (log_ratio < 0).any():
        return float(times[0])
    last = int(np.flatnonzero(log_ratio < 0)[-1])
    if last == len(times) - 1:
        return np.inf
    return float(np.interp(0.0, log_ratio[last : last + 2], times[last : last + 2]))
