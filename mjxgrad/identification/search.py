r"""The search: nonlinear least squares by differences of whole motions, over horizons that grow.

A derivative is a secant: two motions that a number parts by a share of what is still left to explain. Far from the answer it
spans the teeth that contacts give a sum of squares, and ever fewer of them as the fit improves. The first eighth of a motion is
nearly linear in its numbers and depends little on chatter; what it tells is where the search begins on a quarter, and so on.
The unknown start of a window affects that window alone, so that one pair of motions of all windows tells each its own.
Where the sum of squares is rugged at its least value, the values are those of an ensemble.
"""

import contextlib
import functools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mjxgrad._arrays import function, instance, whole
from mjxgrad._text import paced
from mjxgrad.identification.ensemble import EXPECTED, LARGEST, MISFIT, MOST, Ensemble, algebra, fit
from mjxgrad.identification.ensemble import outlook as ensemble_outlook
from mjxgrad.identification.ensemble import size as ensemble_size
from mjxgrad.identification.motions import AT_ONCE, Motions
from mjxgrad.identification.normal import distinct, factors_of, solved, split
from mjxgrad.identification.parameters import Parameter, check_entries
from mjxgrad.identification.recording import Recording, Windows, after_start, doubts, spread, stack
from mjxgrad.identification.result import Identification, Outlook, Stopped, durations, exceeds_noise, statistics
from mjxgrad.rollouts import DivergedError
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.stepping import Contact

Log = Callable[[int, dict[str, float]], None] | None
_HORIZONS = (0.125, 0.25, 0.5, 1.0)  # of the steps
_WIDE, _NARROW = 0.3, 0.5  # widths of secants: of what is left to explain; of a standard error
_FIRST, _WIDEST = 0.02, 0.2  # widths of secants by a coordinate
_DAMPED, _EASED, _RAISED = (1e-2, 1e4), 0.25, 6.0  # damping: first and last; factors
_ENOUGH, _CLOSE = (
    1e-2,
    1e-6,
)  # relative gain of an early step at which the horizon grows; square of standard errors to go
_LONGEST = 1.0  # step in a coordinate at most
_TRIALS = (12, 40)  # steps tried at an early horizon and at the last
_NUM_AWAY, _AWAY, _RUGGED = 12, 2.0, 0.2  # motions and their standard errors away; share of changes that is not linear
_DOUBT = 2.0  # times the difference to secants of half the width, which is 3/4 of an error, or more if motions jump
_EXACT = 1e-6  # of the first residuals: nothing is left
_LEFT = 0.3  # of the first residuals, above which better values are sought where the noise is not known
_SCATTERED, _BEST = 512, 3  # motions between the bounds, and those from which descents begin anew
_ROUNDS = 32  # horizons over which they are chosen; with 16 one of five recordings of a turning box is lost
_SAID = 8  # of these horizons, after one of which something is said
_KEPT, _BESIDE = 8, 0.5  # of how many one is kept; how far beside these others are tried, in their spreads
_SPREAD = 0.05  # of a coordinate, by which the first motions of an ensemble differ at least
_DESCENT = 8  # derivatives of whole motions that a descent takes, about
_TIMED = 16  # motions from whose duration that of others is foretold
_ALIKE = (0.1, 0.05)  # two ends: relative difference of their sums of squares, and that of coordinates
_CORE = 0.3  # of the noise or of the first residuals, beyond which a residual of these counts by its logarithm


class Point(NamedTuple):
    """Coordinates of the values, and changes of the starts of windows."""

    values: Float[np.ndarray, " dim"]
    starts: Float[np.ndarray, "windows free"]


class _End(NamedTuple):
    """The end of a descent or of ensembles: the point, factors of residuals and derivative there, and the sum of squares."""

    point: Point
    factors: Float[np.ndarray, "windows rows columns"]
    squares: float
    residual: Float[np.ndarray, "windows numbers"] | None  # of a single motion
    linear: "_Linear | None" = None  # the derivative that gave the factors
    many: Ensemble | None = None
    stopped: Stopped = Stopped.CONVERGED


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
    progress: bool = True,
) -> Identification:
    r"""Identify parameters of a scene from recorded motions, through contact.

    Minimises $\sum (y_\text{simulated}(\theta) - y_\text{measured})^2 / \text{noise}^2$ by differences of whole motions. Where
    contacts chatter, a single motion tells little: then the mean of many motions is fitted, and the intervals include the
    chatter. Ctrl-C ends the search with the best values so far.

    Args:
        scene: the scene with nominal values.
        parameters: parameters by name, from `mass`, `friction`, `number` and the like, or a `Parameter` of your own.
        recordings: recordings of the scene.
        held_out: recordings for validation only.
        delay: name of the parameter that delays the controls beyond the recorded times (s); None for no delay.
        free_start: whether the starts are unknown, too. None is for those that are the first row of a recording, as far as it
            was measured, and as noisy; True is for all; with False all are exact.
        contact: as in `rollout`. None is MuJoCo's motion, by C MuJoCo, which recordings by MuJoCo need, for the intervals do
            not cover the error of another one. `mg.Onset()` is a smoother motion, for recordings of real things.
        max_steps: largest number of derivatives; motions of an ensemble are not counted.
        log: called as `log(step, metrics)` after each derivative or ensemble; step 0 is the nominal motion. Metrics are `rms`,
            `share`, `seconds`, `most`, `motions`, `ensemble`, `start` and `starts`. The share of the motions was simulated. The
            present part of the search takes these seconds more, about; the whole takes `most` at most. An rms is of one
            motion, or of the mean of many over the covariance of noise and chatter; their ensembles are numbered from 1.
            Where more than noise is left, 512 other starts are compared, and the descents from the best are numbered from 1.
        progress: whether a search of more than two seconds tells on stderr how far it is, without a log.

    Returns:
        The values, their intervals, and undetermined parameters; `print(result.summary())`.

    Raises:
        ValueError: if there are no parameters or recordings, two parameters are of the same number, nothing was measured, or
            shapes do not fit the scene.
        DivergedError: if the simulation diverges with the nominal values.
    """
    whole("max_steps", max_steps)
    given = _checked(scene, parameters, recordings, delay, free_start, contact)
    instance("held_out", held_out, Sequence, "a list of recordings")
    for part in held_out:
        instance("recordings", part, Recording, "of mg.identification.Recording")
    judged = None
    if held_out:  # what does not fit the scene is refused before the search
        windows = stack(given.motions.scene, held_out)
        judged = after_start(windows, noise := spread(scene, held_out, free_start)), noise
    function("log", log, "step", "metrics")
    instance("progress", progress, bool, "True or False")
    has_noise = all(one.knows_noise and set(one.noise) == set(one.measured) for one in recordings)
    if log is None and progress:
        say = paced("identify")
        log = lambda step, metrics: say(as_text(step, metrics, has_noise))  # noqa: E731
    search = _Search(given, max_steps, log)
    try:
        stopped = search.run(has_noise)
    except KeyboardInterrupt:
        stopped = Stopped.INTERRUPTED
    if stopped in (Stopped.INTERRUPTED, Stopped.STEPS):
        with contextlib.suppress(KeyboardInterrupt):
            search.keep_best()
    return _identified(search, stopped, judged, has_noise)


def as_text(step: int, metrics: dict[str, float], has_noise: bool) -> str:
    """Return what the log of `identify` is given as a sentence."""
    part = "" if metrics["share"] == 1 else f" over the first {100 * metrics['share']:.0f} %"
    num, ensemble, index, count = (int(metrics[name]) for name in ("motions", "ensemble", "start", "starts"))
    doing = f", other start {index} of {count}" if index else f", best of {count} other starts" if count > 1 else ""
    doing += f", ensemble {ensemble} of at most {MOST}, mean of {num} motions" if ensemble else ""
    error = f"error {metrics['rms']:.3g} times the {'noise' if has_noise else 'motion'}"
    return f"step {step}: {error}{part}{doing}, {durations((metrics['seconds'], metrics['most']))} to go"


def outlook(
    scene: Scene,
    parameters: Mapping[str, Parameter],
    recordings: Sequence[Recording],
    *,
    delay: str | None = None,
    free_start: bool | None = None,
    contact: Contact | None = None,
) -> Outlook:
    """Return what recordings can tell of parameters, and what a search would take, before `identify` with these arguments.

    The relative errors are those of a linear model at the nominal values, if the noise is as stated. Where contacts chatter, it
    is a model of the mean of 192 motions or more, as `identify` fits it; errors at the end can be several times larger or
    smaller.

    Raises:
        ValueError: as `identify`.
        DivergedError: as `identify`.
    """
    search = _Search(_checked(scene, parameters, recordings, delay, free_start, contact), 1, None)
    problem, start = search.problem, search.end
    residual = problem.residuals([start.point], problem.num_steps)[0]
    widths = np.full(problem.count, _FIRST), np.full(problem.sizes.shape[1], 0.3)
    # Half a standard error is the next width.
    half = _NARROW / max(float(np.linalg.norm(residual)), 1e-300)
    linear = search.linear(start.point, residual, widths, problem.num_steps, half)
    seconds, more = search.price(is_rugged := search.is_rugged(linear, start.point, 1.0))
    coordinates, factors = problem.motions.coordinates, None
    if is_rugged:  # jumps tell single secants apart, and much better than motions tell numbers
        with contextlib.suppress(DivergedError):
            factors = search.mean(start.point)
    if not (is_mean := factors is not None):
        narrow = np.minimum(widths[0], linear.widths[0]), np.minimum(widths[1], linear.widths[1])
        linear = search.linear(start.point, residual, narrow, problem.num_steps, 1.0)
        factors = search.told(start.point, residual, linear)
    slope = _slope(problem, factors, coordinates.nominal)
    found = statistics(coordinates, coordinates.nominal, float(problem.num_numbers), slope, problem.num_numbers, 0)
    return Outlook(coordinates, found, seconds, more, len(problem.sizes), problem.num_steps, is_rugged, is_mean)


def _checked(
    scene: Scene, parameters: Mapping[str, Parameter], recordings: Sequence[Recording], delay: Any, free_start: Any,
    contact: Contact | None,
) -> "_Problem":  # fmt: skip
    if isinstance(recordings, Recording) or not recordings:
        given = "a recording" if isinstance(recordings, Recording) else "none"
        raise ValueError(f"recordings must hold at least one, in a list, got {given}")
    instance("parameters", parameters, Mapping, "a dict from names to parameters")
    for part in parameters.values():
        instance("parameters", part, Parameter, "of mg.identification, such as mass(scene, 'torso')")
    instance("scene", scene, Scene, "of mg.load_scene")
    for part in recordings:
        instance("recordings", part, Recording, "of mg.identification.Recording")
    if delay is not None and delay not in parameters:
        raise ValueError(f"delay must name one of the parameters {sorted(parameters)}, got {delay!r}")
    instance("free_start", free_start, bool | None, "True, False or None")
    check_entries(scene, parameters)
    return _Problem(Motions(scene, parameters, delay=delay, contact=contact), recordings, free_start)


class _Problem:
    """Recordings as windows, and the motions that explain them."""

    def __init__(self, motions: Motions, recordings: Sequence[Recording], free_start: bool | None):
        self.motions, self.free_start = motions, free_start
        self.windows = stack(motions.scene, recordings)
        self.spread = spread(motions.scene, recordings, free_start)
        # One unknown for each noisy number of a start, in units of its noise, or for all of them.
        sizes = np.ones_like(self.spread) if free_start else self.spread
        self.free = np.flatnonzero(sizes.any(axis=0))
        self.sizes = sizes[:, self.free]
        self.num_offsets = int(np.count_nonzero(self.sizes))  # a start that is exact has none
        for one in recordings:
            for text in doubts(motions.scene, one, free_start):
                warnings.warn(f"{motions.scene.name}: in {one.name}, {text}", SceneWarning, stacklevel=2)
        self.count, self.num_steps = len(motions.coordinates.names), self.windows.controls.shape[1]
        self.num_numbers = num_numbers(self.windows)
        if not self.num_numbers:
            raise ValueError("recordings must hold something that was measured, got NaN alone")

    def offsets(self, starts: Float[np.ndarray, "*points windows free"]) -> Float[np.ndarray, "*points windows both"]:
        """Return changes of the starts (m, rad, m/s, rad/s)."""
        found = np.zeros((*starts.shape[:-1], self.spread.shape[1]))
        found[..., self.free] = starts * self.sizes
        return found

    def residuals(self, points: Sequence[Point], steps: int) -> Float[np.ndarray, "points windows numbers"]:
        """Return residuals over so many steps, in units of the noise."""
        values, starts = (np.stack(parts) for parts in zip(*points, strict=True))
        found = self.motions.coordinates.values(values)
        return self.motions.residuals(self.windows, found, self.offsets(starts), steps)


class _Search:
    """A search and how far it has come: an interruption finds its best end so far."""

    def __init__(self, problem: _Problem, max_steps: int, log: Log):
        self.problem, self._most, self._log = problem, max_steps, log
        self.num_steps, self._begun = 0, time.monotonic()
        self.share = 0.0  # of the recordings over which derivatives were taken
        self._rounding = float(np.finfo(problem.motions.scene.data.qpos.dtype).eps) ** 0.75
        self._to_go = 0.0  # of the last descent, standard errors squared
        self._early: list[Point] = []  # visited over a part of the recordings
        # Motions that this part of the search takes, about; those that it can take beyond that; those that can follow.
        self._ahead, self._beyond, self._later = 0.0, 0.0, 0.0
        self._others = 0.0  # motions that other starts can take, while they may be needed
        self._noise: float | None = None
        self._start, self._starts = 0, 1  # which of how many other starts
        start = Point(np.zeros(problem.count), np.zeros(problem.sizes.shape))
        problem.residuals([start], problem.num_steps)  # compiles
        self._fixed = 0.0  # what a motion of no steps takes, in whole motions
        began = time.monotonic()
        residual = problem.residuals([start] * _TIMED, problem.num_steps)[0]
        whole = time.monotonic() - began
        self.pace = whole / self._work(_TIMED, problem.num_steps)
        if not problem.motions.compiles and problem.num_steps > 1:
            problem.residuals([start] * _TIMED, 1)
            self._fixed = min((time.monotonic() - began) / whole - 1.0, 1.0)
        if not np.isfinite(residual).all():
            raise DivergedError(
                "nominal values must give motions that stay finite, got one that diverged: begin elsewhere"
            )
        self.first = math.sqrt((residual**2).sum() / problem.num_numbers)
        nothing = np.zeros((*residual.shape, problem.count)), np.zeros((*residual.shape, problem.sizes.shape[1]))
        self._none = factors_of(residual, *nothing)  # where no derivative was taken
        self.end = _End(start, self._none, float((residual**2).sum()), residual)
        self._single = self.end  # the best of a descent

    def residuals(self, points: Sequence[Point], steps: int) -> Float[np.ndarray, "points windows numbers"]:
        """Return residuals over so many steps, and see how long a motion takes."""
        began = time.monotonic()
        found = self.problem.residuals(points, steps)
        if len(points) >= _TIMED:
            self.pace = (self.pace + (time.monotonic() - began) / self._work(len(points), steps)) / 2
        return found

    def _work(self, num: int, steps: int) -> float:
        """Return the price of simulations in motions of all windows; a compiled program always makes as many at once."""
        num = -(-num // AT_ONCE) * AT_ONCE if self.problem.motions.compiles else num
        return num * (self._fixed + (1.0 - self._fixed) * steps / self.problem.num_steps)

    def _derivative(self, steps: int) -> float:
        return self._work(2 * (self.problem.count + self.problem.sizes.shape[1]), steps)

    def _horizons(self) -> list[int]:
        """Return the numbers of steps over which other starts are compared."""
        shares = _HORIZONS if self.problem.motions.compiles else np.geomspace(_HORIZONS[0], 1.0, _ROUNDS)
        return sorted({max(round(share * self.problem.num_steps), 1) for share in shares})

    def price(self, is_rugged: bool) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the seconds that a search takes, and those of other starts, each about and at most."""
        descent, comparison, pace = self._descent(), self._comparison(), self.pace
        expected, most = (EXPECTED * self._ensemble, LARGEST * self._ensemble) if is_rugged else (0.0, self._ensembles)
        more = pace * (comparison + descent), pace * (comparison + _BEST * descent + most)
        return (pace * (descent + expected), pace * (descent + most)), more

    @functools.cached_property
    def _ensemble(self) -> float:
        """The price of an ensemble of the first size and of its algebra, in motions of all windows."""
        problem, columns = self.problem, (self.problem.count, self.problem.sizes.shape[1])
        numbers = problem.num_numbers // len(problem.sizes)
        motions = self._work(ensemble_size(sum(columns)), problem.num_steps)
        return motions + len(problem.sizes) * algebra(*columns, numbers) / self.pace

    @property
    def _ensembles(self) -> float:
        """The price of ensembles at most, in motions of all windows; 0 where nothing can touch, since little chatters then."""
        return LARGEST * self._ensemble if self.problem.motions.scene.pairs else 0.0

    def _descent(self) -> float:
        return _DESCENT * self._derivative(self.problem.num_steps)

    def _comparison(self) -> float:
        return sum(self._work(_SCATTERED, steps) for steps in self._horizons())

    def run(self, has_noise: bool) -> Stopped:
        """Return why the search ended."""
        self._noise = noise = 1.0 if has_noise else None
        self._ahead, self._later = self._descent(), self._ensembles
        self._others = self._comparison() + _BEST * self._descent() + self._later
        self._say(self.first)
        stopped, is_rugged = self._descend(self.end.point, noise)
        if stopped is Stopped.STEPS:
            return stopped
        if is_rugged:
            self._average(self._single, self.noise(noise))
        if not self._is_off(noise) and self.end.stopped is not Stopped.STALLED:
            return self.end.stopped
        ends, is_rugged = [self._single], False
        for point in self._scattered(noise):
            try:
                stopped, is_other_rugged = self._descend(point, noise)
            except DivergedError:  # the ends before it stay
                continue
            if stopped is Stopped.STEPS:
                return stopped
            if any(self._is_alike(self._single, one) for one in ends):
                break
            if self._single.squares < min(one.squares for one in ends):
                is_rugged = is_other_rugged
            ends.append(self._single)
        # Ensembles begin anew where another start has led to a better motion than the first, or where they did not settle.
        if is_rugged or self.end.stopped is Stopped.STALLED:
            best = min(ends, key=lambda one: one.squares)
            self._average(best if is_rugged else self.end, self.noise(noise))
        return self.end.stopped

    def _is_alike(self, one: _End, other: _End) -> bool:
        """Return whether two descents ended as well and beside one another, so that further starts will, too."""
        close, beside = _ALIKE
        apart = np.abs(one.point.values - other.point.values).max()
        return bool(abs(one.squares - other.squares) < close * other.squares and apart < beside)

    def noise(self, known: float | None) -> float:
        """Return the size of the noise: as stated, else what is left, of which some may be chatter."""
        return known or max(math.sqrt(self.end.squares / self.problem.num_numbers), 1e-12)

    @property
    def seconds(self) -> float:
        """Return the seconds since the search began."""
        return time.monotonic() - self._begun

    def _say(
        self, rms: float, share: float = 1.0, motions: int = 1, ensemble: int = 0, starts: int | None = None
    ) -> None:
        if self._log is not None:
            ahead = max(self._ahead, self._derivative(self.problem.num_steps))
            most = ahead + self._beyond + self._later + self._others * self._is_off(self._noise)
            told = {"rms": rms, "share": share, "seconds": self.pace * ahead, "most": self.pace * most}
            told |= {"motions": motions, "ensemble": ensemble, "start": self._start, "starts": starts or self._starts}
            self._log(self.num_steps, told)

    def keep_best(self) -> None:
        """Keep the point whose whole motion is best of all that were visited, with the derivative there."""
        steps, best = self.problem.num_steps, self.end
        if self._early:
            found = self.problem.residuals(self._early, steps)
            squares = (found**2).sum(axis=(1, 2))
            i = int(squares.argmin())
            if squares[i] < best.squares:
                best = _End(self._early[i], self._none, float(squares[i]), found[i])
        if best.factors is self._none and best.residual is not None and self.num_steps:
            first = np.full(self.problem.count, _FIRST), np.full(self.problem.sizes.shape[1], _FIRST)
            linear = self.linear(best.point, best.residual, first, steps, 1.0)
            self.end = best._replace(factors=factors_of(best.residual, linear.slope, linear.by_start), linear=linear)

    def _descend(self, point: Point, noise: float | None) -> tuple[Stopped, bool]:
        """Minimise the residuals from a point over horizons that grow; return why it ended and whether the end is rugged."""
        problem = self.problem
        self._single = self.end._replace(squares=np.inf)
        self._ahead = self._descent()
        widths: tuple[np.ndarray, np.ndarray] | None = None
        needed = 2 * (problem.count + problem.sizes.shape[1])
        horizons = [max(round(share * problem.num_steps), 1) for share in _HORIZONS]
        for steps in horizons[:-1]:
            if self._counts(steps) > needed:
                stopped, point, _, widths = self._minimise(point, widths, steps, is_last=False)
                if stopped is Stopped.STEPS:
                    return stopped, False
        stopped, point, linear, widths = self._minimise(point, widths, horizons[-1], is_last=False)
        if stopped is Stopped.STEPS:
            return stopped, False
        if self.is_rugged(linear, point, self.noise(noise)):
            return stopped, True
        stopped, point, linear, _ = self._minimise(point, widths, horizons[-1], is_last=True)
        # Beside a jump no step is better, though derivatives foretell one.
        is_beside = self._to_go > 1.0 and not self._is_exact(math.sqrt(self.end.squares))
        return stopped, is_beside or self.is_rugged(linear, point, self.noise(noise))

    def _is_exact(self, left: float) -> bool:
        """Return whether so much is left that differences would be rounding."""
        return left < _EXACT * self.first * math.sqrt(self.problem.num_numbers)

    def _minimise(
        self, point: Point, widths: tuple[np.ndarray, np.ndarray] | None, steps: int, is_last: bool
    ) -> tuple[Stopped, Point, "_Linear", tuple[np.ndarray, np.ndarray]]:
        """Go down by Levenberg and Marquardt's steps over so many time steps."""
        problem, is_whole = self.problem, steps == self.problem.num_steps
        numbers = problem.num_numbers if is_whole else max(int(self._counts(steps)), 1)
        residual: np.ndarray = self.residuals([point], steps)[0]
        first = np.full(problem.count, _FIRST), np.full(problem.sizes.shape[1], _FIRST)
        near: tuple[np.ndarray, np.ndarray] = widths if widths is not None else first
        share = _NARROW / math.sqrt(numbers) if is_last else _WIDE
        if not np.isfinite(residual).all():
            raise DivergedError("the best values so far give a motion that diverges")
        damping, trials, box = _DAMPED[0], 0, problem.motions.coordinates.box()
        while True:
            total = float((residual**2).sum())
            linear = self.linear(point, residual, near, steps, share)
            near = linear.widths
            factors = factors_of(residual, linear.slope, linear.by_start)
            if is_whole:
                here = _End(point, factors, total, residual, linear)
                self._single, self.end = (here if total <= one.squares else one for one in (self._single, self.end))
            else:
                self._early.append(point)
            self.share = max(self.share, steps / problem.num_steps)
            self.num_steps, self._ahead = self.num_steps + 1, self._ahead - self._derivative(steps)
            self._say(math.sqrt(total / numbers), steps / problem.num_steps)
            room = box[0] - point.values, box[1] - point.values
            if self.num_steps >= self._most:
                return Stopped.STEPS, point, linear, near
            newton = solved(factors, problem.count, room)
            self._to_go = newton.length * numbers / max(total, 1e-300)
            is_exact = math.sqrt(total / numbers) < self._rounding * self.first
            if is_exact or (is_whole and self._to_go < _CLOSE):
                return Stopped.CONVERGED, point, linear, near
            while True:
                trials += 1
                step = solved(factors, problem.count, room, damping)
                longest = np.abs(step.values).max(initial=0.0)
                shorter = min(1.0, _LONGEST / max(longest, 1e-300))
                trial = Point(np.clip(point.values + shorter * step.values, *box), point.starts + shorter * step.starts)
                after = self.residuals([trial], steps)[0]
                is_better = bool(np.isfinite(after).all()) and float((after**2).sum()) < total
                damping *= _EASED if is_better else _RAISED
                if is_better or damping > _DAMPED[1] or trials >= _TRIALS[is_whole]:
                    break
            if not is_better:
                return Stopped.CONVERGED, point, linear, near
            gain, point, residual = total - float((after**2).sum()), trial, after
            if gain * (numbers if is_last else 1) < (_CLOSE if is_last else _ENOUGH) * total:
                return Stopped.CONVERGED, point, linear, near

    def _counts(self, steps: int) -> int:
        windows = self.problem.windows
        is_in = (windows.index + windows.share <= steps)[..., None]
        return sum(int(((weight > 0) & is_in).sum()) for weight in windows.weight.values())

    def told(self, point: Point, residual: np.ndarray, linear: "_Linear") -> np.ndarray:
        """Return factors without what tells numbers apart by the errors of secants, which narrower ones show."""
        problem, dim, factors = self.problem, self.problem.count, factors_of(residual, linear.slope, linear.by_start)
        if dim < 2:
            return factors
        half = linear.used[0] / 2, linear.used[1] / 2
        finer = self.linear(point, residual, half, problem.num_steps, 1.0)
        apart = np.concatenate([linear.by_start - finer.by_start, linear.slope - finer.slope], axis=2)
        both = factors_of(residual, np.concatenate([linear.slope, apart], axis=2), linear.by_start)
        by_start, mixed, slope, _ = split(both, both.shape[2] - 1 - linear.by_start.shape[2])
        # By the shares of starts that go with a value, their errors are in its derivative, too.
        shares = -np.linalg.pinv(by_start, rcond=1e-6) @ mixed[..., :dim]
        num = len(slope) // len(factors)
        errors = slope[:, dim:].reshape(len(factors), num, -1)
        errors = (errors[..., -dim:] + errors[..., :-dim] @ shares).reshape(-1, dim)
        slope = slope[:, :dim]
        factors[..., -1 - dim : -1] = factors[..., -1 - dim : -1] @ distinct(
            slope.T @ slope, _DOUBT**2 * errors.T @ errors
        )
        return factors

    def linear(
        self, point: Point, residual: np.ndarray, widths: tuple[np.ndarray, np.ndarray], steps: int, share: float
    ) -> "_Linear":
        """Return derivatives by secants, and widths of the next: a share of what is left to explain."""
        problem, points = self.problem, []
        for part, sizes in enumerate(widths):
            for i, width in enumerate(sizes):
                for sign in (1.0, -1.0):
                    parts = [point.values.copy(), point.starts.copy()]
                    parts[part][..., i] += sign * width
                    points.append(Point(*parts))
        box = problem.motions.coordinates.box()
        points = [Point(np.clip(values, *box), starts) for values, starts in points]
        found = self.residuals(points, steps) if points else np.zeros((0, *residual.shape))
        is_finite, count = np.isfinite(found).all(axis=(1, 2)), problem.count
        found[~is_finite] = residual
        for i in np.flatnonzero(~is_finite):
            points[i] = point
        coordinates, columns = problem.motions.coordinates, []
        rates = coordinates.rates(coordinates.values(point.values))
        for i in range(0, len(points), 2):
            (values, starts), (others, begun) = points[i], points[i + 1]
            if i // 2 < count:  # by the value: residuals are more linear in it than in its logarithm
                apart = ((coordinates.values(values) - coordinates.values(others)) / rates)[i // 2]
            else:
                apart = (starts - begun)[:, i // 2 - count, None]
            columns.append((found[i] - found[i + 1]) / np.where(apart == 0, np.inf, apart))
        both = np.stack(columns, axis=-1) if columns else np.zeros((*residual.shape, 0))
        slope, by_start = both[..., :count], both[..., count:]
        left = max(float(np.linalg.norm(residual)), 1e-300)
        felt = np.linalg.norm(slope, axis=(0, 1)), np.linalg.norm(by_start, axis=(0, 1)) / math.sqrt(len(residual))
        least = math.sqrt(float(np.finfo(problem.motions.scene.data.qpos.dtype).eps)) * 10
        left_of = left, left / math.sqrt(len(residual))
        widest = _WIDEST, 1.0 if not problem.free_start else _WIDEST / 2
        new = tuple(
            np.clip(share * size / np.where(one > 0, one, 1e-300), least, most)
            for size, one, most in zip(left_of, felt, widest, strict=True)
        )
        return _Linear(slope, by_start, new, widths)

    def is_rugged(self, linear: "_Linear", point: Point, noise: float) -> bool:
        """Return whether motions some standard errors away are not where derivatives foretell."""
        problem, rng = self.problem, np.random.default_rng(0)
        residual = problem.residuals([point], problem.num_steps)[0]
        if self._is_exact(float(np.linalg.norm(residual))):
            return False
        factors = factors_of(residual, linear.slope, linear.by_start)
        by_start, mixed, slope, _ = split(factors, problem.count)
        inner, root = np.linalg.pinv(by_start, rcond=1e-6), _AWAY * noise * np.linalg.pinv(slope, rcond=1e-6)
        box, points = problem.motions.coordinates.box(), []
        for _ in range(_NUM_AWAY):
            change = np.clip(root @ rng.normal(size=root.shape[1]), -_WIDEST, _WIDEST)
            values = np.clip(point.values + change, *box)
            change = values - point.values
            starts = np.einsum(
                "wij,wj->wi", inner, _AWAY * noise * rng.normal(size=point.starts.shape) - mixed[..., :-1] @ change
            )
            points.append(Point(values, point.starts + starts))
        found = problem.residuals(points, problem.num_steps)
        ratios = []
        for one, (values, starts) in zip(found, points, strict=True):
            change = linear.slope @ (values - point.values)
            change += np.einsum("wns,ws->wn", linear.by_start, starts - point.starts)
            parted = np.sum((one - residual - change) ** 2) if np.isfinite(one).all() else np.inf
            ratios.append(parted / max(float(np.sum(change**2)), 1e-300))
        return bool(np.median(ratios) > _RUGGED) and bool(np.any(linear.slope))

    def _is_off(self, noise: float | None) -> bool:
        """Return whether more is left than noise has by chance; if that is not known, whether little was explained."""
        after = math.sqrt(self.end.squares / self.problem.num_numbers)
        if self.end.many is not None:
            return after > MISFIT * self.noise(noise)
        if noise:
            freedom = self.problem.num_numbers - self.problem.count - self.problem.num_offsets
            return exceeds_noise(after / noise, freedom)
        return after > _LEFT * self.first

    def _scattered(self, noise: float | None) -> Iterator[Point]:
        """Yield the points whose motions fit best, most of their course, of many between the bounds and beside the best."""
        # What fits a first part is where to look for what fits more of it: chaos hides the rest at first.
        problem, rng, horizons = self.problem, np.random.default_rng(1), self._horizons()
        low, high = problem.motions.coordinates.box()
        low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
        values = rng.uniform(low, high, (_SCATTERED, problem.count))
        starts = np.zeros((_SCATTERED, *problem.sizes.shape)) + self.end.point.starts
        self._ahead, self._beyond, self._others = self._comparison(), 0.0, 0.0
        self._later = _BEST * self._descent() + self._ensembles
        for i, steps in enumerate(horizons, start=1):
            found = self.residuals([Point(*pair) for pair in zip(values, starts, strict=True)], steps)
            self._ahead -= self._work(_SCATTERED, steps)
            losses = np.log1p((found / (_CORE * (noise or self.first))) ** 2).sum(axis=(1, 2))
            order = np.argsort(np.where(np.isfinite(losses), losses, np.inf))
            best = values[order[: _SCATTERED // _KEPT]]
            if i % _SAID == 1 or i == len(horizons):
                rms = float(np.linalg.norm(found[order[0]])) / math.sqrt(max(self._counts(steps), 1))
                self._say(rms, steps / problem.num_steps, starts=_SCATTERED)
            if i == len(horizons):
                chosen: list[int] = []  # of those beside one another the better one
                for one in order[:_BEST]:
                    is_apart = all(np.abs(values[one] - values[other]).max() > _ALIKE[1] for other in chosen)
                    chosen += [one] if np.isfinite(losses[one]) and is_apart else []
                self._starts = len(chosen)
                for self._start, one in enumerate(chosen, start=1):
                    self._later = (len(chosen) - self._start) * self._descent() + self._ensembles
                    yield Point(values[one], starts[one])
                return
            beside = best[rng.integers(len(best), size=_SCATTERED - len(best))]
            beside = beside + _BESIDE * best.std(axis=0) * rng.normal(size=beside.shape)
            values = np.concatenate([best, np.clip(beside, low, high)])

    def mean(self, point: Point) -> np.ndarray:
        """Return the factors of the mean of many motions about a point, if the noise is as stated."""
        problem, widths = self.problem, np.full(self.problem.count, _SPREAD)
        own = np.full(problem.sizes.shape, _SPREAD if problem.free_start else 1.0)
        box = problem.motions.coordinates.box()
        return ensemble_outlook(self._whole, point, (widths, own), box, 1.0)

    def _whole(self, values: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return residuals of whole motions."""
        return self.residuals([Point(*pair) for pair in zip(values, starts, strict=True)], self.problem.num_steps)

    def _average(self, alone: _End, noise: float) -> None:
        """Fit the mean of many motions, from the end of a descent, and keep it unless that explains nothing more."""
        problem, before, began, index, spent = self.problem, self.end, time.monotonic(), 0, 0
        self._later = 0.0

        def say(best: Ensemble, squares: float, motions: int, ahead: tuple[float, float]) -> None:
            nonlocal index, spent
            index, spent = index + 1, spent + motions
            pace = (time.monotonic() - began) / spent / self.pace  # with the algebra
            self.num_steps += 1
            self._ahead, self._beyond = ahead[0] * pace, (ahead[1] - ahead[0]) * pace
            if best.squares < before.squares:
                stopped = Stopped.CONVERGED if best.is_settled else Stopped.STALLED
                self.end = _End(Point(best.values, best.starts), best.factors, best.squares, None, None, best, stopped)
            self._say(math.sqrt(squares / problem.num_numbers), motions=motions, ensemble=index)

        by_start, _, slope, _ = split(alone.factors, problem.count)
        excess = max(math.sqrt(alone.squares / problem.num_numbers), noise)
        widths = np.hypot(_SPREAD, excess * np.linalg.norm(np.linalg.pinv(slope, rcond=1e-6), axis=1))
        own = np.linalg.norm(np.linalg.pinv(by_start, rcond=1e-6), axis=2) * 3 * excess
        own = own if problem.free_start else np.full(problem.sizes.shape, noise)
        box = problem.motions.coordinates.box()
        try:
            fit(self._whole, alone.point, (np.minimum(widths, _WIDEST), own), box, noise, problem.num_numbers, say)
        except DivergedError:
            self.end = self.end._replace(stopped=Stopped.STALLED) if self.end is before else self.end


class _Linear(NamedTuple):
    """Derivatives by coordinates and by the starts of windows, and widths for the next ones."""

    slope: Float[np.ndarray, "windows numbers dim"]
    by_start: Float[np.ndarray, "windows numbers free"]
    widths: Any
    used: tuple[np.ndarray, np.ndarray]  # widths of these secants


def num_numbers(windows: Windows) -> int:
    """Return the number of measured numbers."""
    return sum(int((weight > 0).sum()) for weight in windows.weight.values())


def _slope(problem: _Problem, factors: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the derivative by the values, orthogonal to the effect of the starts."""
    return split(factors, problem.count)[2] / problem.motions.coordinates.rates(values)


def _identified(
    search: _Search, stopped: Stopped, held_out: tuple[Windows, np.ndarray] | None, has_noise: bool
) -> Identification:
    """Return the values at the end of a search with all that the recordings tell of them."""
    problem, end = search.problem, search.end
    coordinates, numbers = problem.motions.coordinates, problem.num_numbers
    values = coordinates.values(end.point.values)
    factors = end.factors
    if end.linear is not None and end.residual is not None and stopped is not Stopped.INTERRUPTED:
        factors = search.told(end.point, end.residual, end.linear)
    slope = _slope(problem, factors, values)
    verdict = statistics(coordinates, values, end.squares, slope, numbers, problem.num_offsets)
    verdict["half_width"] = coordinates.unravel(verdict["half_width"])
    signals = np.zeros((1, 2, 1)) if end.residual is None else end.residual.reshape(*problem.windows.index.shape, -1)
    motions = problem.motions
    return Identification(
        **verdict,
        values=coordinates.unravel(values),
        start=coordinates.unravel(coordinates.nominal),
        names=coordinates.names,
        at_bounds=tuple(np.array(coordinates.names)[coordinates.is_at_bound(values)].tolist()),
        rms=(search.first, math.sqrt(end.squares / numbers)),
        has_noise=has_noise,
        held_out_rms=None if stopped is Stopped.INTERRUPTED or not held_out else _held_out(search, *held_out),
        offsets=problem.offsets(end.point.starts) if problem.free.size else None,
        correlation=float((signals[:, 1:] * signals[:, :-1]).sum() / ((signals**2).sum() or 1.0)),
        num_motions=1 if end.many is None else len(end.many.drawn),
        num_numbers=numbers,
        num_steps=search.num_steps,
        share=search.share,
        seconds=search.seconds,
        stopped=stopped,
        scene=motions.put(values),
        coordinates=coordinates,
        units={name: parameter.unit for name, parameter in motions.parameters.items()},
    )


def _held_out(search: _Search, judged: Windows, noise: np.ndarray) -> tuple[float, float]:
    """Return the rms residuals of held-out windows at the nominal values and in the end; the noise is that of their starts."""
    problem, motions, end = search.problem, search.problem.motions, search.end
    starts, count = np.zeros(noise.shape), math.sqrt(num_numbers(judged))
    begins, known = (np.hstack([np.asarray(w.state.qpos), np.asarray(w.state.qvel)]) for w in (judged, problem.windows))
    # The end of a recording has the start that was found for its beginning.
    is_same = np.all(begins[:, None] == known, axis=2) & noise.any(axis=1, keepdims=True)
    found = np.where(is_same.any(axis=1)[:, None], problem.offsets(end.point.starts)[is_same.argmax(axis=1)], 0.0)
    values = motions.coordinates.values(np.stack([np.zeros(problem.count), end.point.values]))
    first, last = motions.residuals(judged, values, np.stack([starts, found]))
    return float(np.linalg.norm(first) / count), float(np.linalg.norm(last) / count)
