r"""The identified values, their intervals, and the parameters that the recordings leave undetermined.

Let $r$ be the residuals in units of the noise, $J = \partial r / \partial \theta$ at the end, $n$ numbers and $p$ unknowns.
Then $s^2 = r^T r / (n - p)$ estimates the ratio of the true to the stated noise variance, and the parameters' covariance is
$s^2 (J^T J)^{-1}$. This assumes a correct model, independent noise, and nearly linear residuals over the interval.
Directions without effect have no interval; they are named. A singular value decomposition of $J$ with columns of length 1
finds them.

References:
    Bates, Watts. Nonlinear Regression Analysis and Its Applications. Wiley 1988, chapters 2 and 3.
"""

import dataclasses
import enum
from pathlib import Path
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Float

from mjxgrad._text import Printed, aligned, duration, format_number, write
from mjxgrad.identification.ensemble import MISFIT
from mjxgrad.identification.normal import simple
from mjxgrad.identification.parameters import Coordinates
from mjxgrad.scene import Scene

_LEVEL = 0.95
_SMALL_PART = 0.05  # least share in a combination for a number to be named
_NOT_TOLD_APART = 1e-6  # of the largest singular value: the data would have to be a million times better
_TIED = 0.9  # correlation of errors that is told
_RELATED = 0.5  # correlation of residuals that makes intervals too narrow by √3
_REMOVED = 1e-3  # of the residuals at the start: less comes from numerical differences
_ENOUGH = 30  # numbers: fewer are as correlated by chance once in a hundred times
_DEPARTS = 2.0  # of what is left of the fitted motions
_BETTER = 0.8  # of the first residuals
_LITTLE = 0.01  # of the motion, where no noise is stated: what sensors with errors of a hundredth of their range leave
_OVERSTATED = 0.7  # of the noise: 30 numbers have less by chance once in a hundred times
CHANCE = 1e-4  # probability that residuals as large are noise
_NO_PART = 1e-4  # largest share of a determined number in undetermined directions


class Stopped(enum.Enum):
    """The reason why a search ended."""

    CONVERGED = "converged"
    STALLED = "stalled"
    STEPS = "max_steps reached"
    INTERRUPTED = "interrupted"


@dataclasses.dataclass(frozen=True)
class Outlook(Printed):
    """Foretell at the nominal values how well recordings tell parameters, and the price of a search.

    Attributes:
        coordinates: bounds and names.
        told: the fields of `statistics`: intervals for noise as stated and contacts that do not chatter.
        seconds: duration of a search, about and at most, on a machine as busy as now. Ensembles grow where chatter asks for it.
        more: seconds more, likewise, where that leaves more than noise: then other starts are compared.
        num_windows: windows, each of `num_steps` steps.
        num_steps: steps of a window.
        is_rugged: whether contacts chatter already at the nominal values.
        is_mean: whether the intervals are those of the mean of many motions, which allow for chatter; without, where most of
            such motions diverge, they will be wider by far.
    """

    coordinates: Coordinates
    told: dict[str, Any]
    seconds: tuple[float, float]
    more: tuple[float, float]
    num_windows: int
    num_steps: int
    is_rugged: bool = False
    is_mean: bool = False

    def rows(self) -> list[tuple[str, ...]]:
        """Return a table of text, header first: name, standard error that the recordings allow, and what it goes with."""
        errors = np.sqrt(np.diag(self.told["covariance"]))
        sizes = np.where(self.coordinates.nominal != 0, np.abs(self.coordinates.nominal), self.coordinates.scale)
        rows = [("parameter", "standard error", "goes with")]
        for name, error, partners in zip(
            self.coordinates.names, errors / sizes, _partners(self.told, self.coordinates), strict=True
        ):
            rows.append((name, f"{100 * error:.2g} %" if np.isfinite(error) else "not told", partners))
        return rows

    def summary(self) -> str:
        """Say the price, and what the recordings tell at the nominal values."""
        count = self.num_windows
        windows = f"{count} recording{'s' * (count > 1)} of {self.num_steps} steps"
        price = f"About {durations(self.seconds).removeprefix('about ')} for {windows}"
        price += f"; {durations(self.more)} more where other starts must be compared."
        lost = [*self.told["without_effect"], *(" with ".join(one) for one in self.told["inseparable"])]
        told = (
            f"At the first values not told: {'; '.join(lost)}."
            if lost
            else "Every number is told, at the first values:"
        )
        if self.is_rugged and self.is_mean:
            told += " Contacts chatter; errors are those of the mean of many motions there, and will change with the values:"
        elif self.is_rugged:
            told += " Contacts chatter, so that the errors will be larger than these by far:"
        apart = [_without_effect(one) for one in self.told["inseparable"]]
        return "\n".join([price, told, *(f"  {line}" for line in aligned(self.rows())), *apart])

    __str__ = __repr__ = summary


@dataclasses.dataclass(frozen=True)
class Identification(Printed):
    """Parameters from recorded motions.

    Attributes:
        values: the identified values, by name.
        start: the nominal values, by name.
        half_width: half-widths of the 95 % intervals, by name; infinite where the recordings determine nothing.
        covariance: covariance of all numbers in the order of `names`; infinite on the diagonal where they are not determined.
        names: one name per number, `gains[1]` within an array.
        condition_number: condition of J with columns of length 1. Beyond a hundred, combinations have narrower intervals.
        without_effect: names on which no measurement depends.
        inseparable: combinations without effect on any measurement, as joint changes relative to the values.
        at_bounds: names that ended at a bound, whose intervals mean little.
        rms: root mean square of the residuals in units of the noise, before and after; about 1 if noise and model are right.
        has_noise: whether the recordings state the noise of every signal.
        held_out_rms: the same for the held-out recordings; None without any.
        offsets: changes of the starts; None where they are known, or where many motions were fitted.
        correlation: correlation of successive residuals of a signal, about 0 if only independent noise is left.
        num_motions: 1, or the number of motions whose mean was fitted since contacts chatter; residuals are then those of the
            mean, over the covariance of noise and chatter.
        num_numbers: number of measured numbers.
        num_steps: number of search steps.
        share: share of the recordings over which the search had come, by time; below 1 where it was cut short.
        seconds: duration of the search.
        stopped: the reason why the search ended.
        scene: the scene with the identified values.
        coordinates: bounds and names, for saving.
        units: units by name.
    """

    values: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    half_width: dict[str, np.ndarray]
    covariance: Float[np.ndarray, "dim dim"]
    names: tuple[str, ...]
    condition_number: float
    without_effect: tuple[str, ...]
    inseparable: tuple[dict[str, float], ...]
    at_bounds: tuple[str, ...]
    rms: tuple[float, float]
    has_noise: bool
    held_out_rms: tuple[float, float] | None
    offsets: Float[np.ndarray, "windows _"] | None
    correlation: float
    num_motions: int
    num_numbers: int
    num_steps: int
    share: float
    seconds: float
    stopped: Stopped
    scene: Scene
    coordinates: Coordinates
    units: dict[str, str]

    @property
    def is_sound(self) -> bool:
        """Whether the search converged, determined every number, and explained the recordings."""
        is_determined = not (self.without_effect or self.inseparable or self.at_bounds)
        return self.stopped is Stopped.CONVERGED and is_determined and not self._is_unexplained

    @property
    def is_measured(self) -> bool:
        """Whether the search got as far as a derivative before an interruption; else the values are the first ones."""
        return self.stopped is not Stopped.INTERRUPTED or len(self.without_effect) < len(self.names)

    @property
    def _is_unexplained(self) -> bool:
        if self.has_noise and self.num_motions > 1:
            return self.rms[1] > MISFIT
        if self.has_noise:
            return exceeds_noise(self.rms[1], self.num_numbers - len(self.names))
        return any(after > max(_BETTER * before, _LITTLE) for before, after in (self.rms, self.held_out_rms or (1, 0)))

    @property
    def headline(self) -> str:
        """The answer: what was found, how surely, whether it fits, and what it took."""
        if not self.is_measured:
            return f"Interrupted before anything was measured; the values are the first ones; {format_number(self.seconds)} s."
        values, halves = (
            np.concatenate([np.ravel(x) for x in part.values()]) for part in (self.values, self.half_width)
        )
        count, is_lost = len(self.names), np.isinf(halves)
        shares = 100 * (halves / np.where(values != 0, np.abs(values), np.inf))[~is_lost]
        surely = f" to {_percent(shares)} %" if (shares > 0).any() else ""
        found = f"All {count} found{surely}" if count > 1 else f"Found{surely}"
        if self.at_bounds:
            found = f"{len(self.at_bounds)} of {count} numbers ended at a bound"
        if is_lost.any():
            found = f"{count - is_lost.sum()} of {count} numbers found"
        if self._is_unexplained:
            found = f"Not found, for {'more than noise' if self.has_noise else 'most of the first error'} is left"
        ended = {
            Stopped.STALLED: "Do not trust: stalled",
            Stopped.STEPS: "Cut short",
            Stopped.INTERRUPTED: "Interrupted",
        }
        if self.stopped in ended:
            found = f"{ended[self.stopped]}, best so far"
        before, after, *held_out = (
            f"{one:.3g}" if self.has_noise else f"{100 * one:.2g} %" if one < 0.995 else f"{100 * one:.0f} %"
            for one in (*self.rms, *(self.held_out_rms or ())[1:])
        )
        unit = "times the noise" if self.has_noise else "of the motion"
        judged = f"; held out {held_out[0]}" if held_out else ""
        return f"{found}: error {after} {unit}, {before} before{judged}; {format_number(self.seconds)} s."

    def summary(self) -> str:
        """Describe the result in text: the values with their intervals, then the warnings."""
        count = len(self.names)
        head = f"{count} number{'s' * (count > 1)} from {self.num_numbers} measured ones in {self.num_steps} steps"
        unit = "units of the noise" if self.has_noise else "the given scales"
        rms = f"Residuals, in {unit}: {self.rms[0]:.3g} at the start, {self.rms[1]:.3g} now"
        if self.held_out_rms is not None:
            rms += f"; held out: {self.held_out_rms[0]:.3g} and {self.held_out_rms[1]:.3g}"
        if self.num_motions > 1:
            rms += f". Contacts chatter: the mean of {self.num_motions} motions is fitted, and error and intervals allow for it"
        warnings = [f"\n{line}" for line in self.warnings()]
        return "\n".join([f"{head}, {self.stopped.value}.", f"{rms}.", "", *aligned(self.rows()), *warnings])

    __str__ = __repr__ = summary

    def rows(self) -> list[tuple[str, ...]]:
        """Return the values as a table of text, header first: name, value, interval, start, bounds, and what it goes with."""
        parts = (self.values, self.half_width, self.start)
        columns = [np.concatenate([np.ravel(part[name]) for name in self.values]) for part in parts]
        told = {"covariance": self.covariance, "inseparable": self.inseparable}
        columns += [self.coordinates.lower, self.coordinates.upper, _partners(told, self.coordinates)]
        spread = "± 95 %" if self.stopped is Stopped.CONVERGED else "± by noise alone"
        rows = [("parameter", "found", spread, "start", "bounds", "goes with")]
        for name, found, half, start, low, high, partners in zip(self.names, *columns, strict=True):
            unit = self.units.get(name.split("[")[0], "")
            shown = (_digits(found, half), f"{half:.2g}" if np.isfinite(half) else "unknown", format_number(start))
            title = f"{name} ({unit})" if unit else name
            rows.append((title, *shown, f"{format_number(low)} to {format_number(high)}", partners))
        return rows if any(row[-1] for row in rows[1:]) else [row[:-1] for row in rows]

    def warnings(self) -> list[str]:
        """Return warnings of a sentence or two each, such as a stalled search or undetermined numbers."""
        found = []
        if self.is_measured and self.stopped in (Stopped.INTERRUPTED, Stopped.STEPS):
            found.append(
                "The search had not converged, so values may be off by many times what noise alone leaves. Go on with these as "
                "first values, or give it more time or steps (--max-steps)."
            )
        if self.is_measured and self.share < 1:
            found.append(
                f"The search stopped when it had used the first {100 * self.share:.0f} % of the recordings. The error is that "
                "over the whole, of the best values visited."
            )
        elif self.has_noise and self._is_unexplained:
            free = "" if self.offsets is not None else "free_start=True (--start free), "
            found.append(
                f"Residuals are {self.rms[1]:.3g} times the noise that was stated, beyond chance: the scene does not "
                "move as recorded, or the search ended in a local minimum; values may be off by more than their intervals. Try "
                f"other first values, {free}more parameters, or correct the noise."
            )
        if self.stopped is Stopped.STALLED:
            found.append(
                "Stalled: the mean of many motions does not settle. Give narrower bounds, shorter recordings or softer contact."
            )
        after, is_enough = self.rms[1], self.num_numbers >= _ENOUGH
        if self.has_noise and after < _OVERSTATED and is_enough:
            found.append(
                f"The stated noise is larger than what is left: {after:.2g} of it; some intervals are too wide."
            )
        left = max(after, 1.0 if self.has_noise else _REMOVED * self.rms[0])
        if self.held_out_rms is not None and self.held_out_rms[1] > _DEPARTS * left:
            found.append(
                f"What was held out departs ({self.held_out_rms[1]:.3g}): it is foretold from its first row, whose noise grows, "
                "most where contacts chatter."
            )
        if self.correlation > _RELATED and after > _REMOVED * self.rms[0] and is_enough:
            starts = "The starts may be noisy: free_start=True (--start free) finds them. " * (self.offsets is None)
            found.append(
                f"Residuals follow one another (correlation {self.correlation:.2f} from one time to the next), so something is "
                f"not as in the scene. {starts}Values may be off by more than their intervals, which assume independent noise."
            )
        if self.without_effect and self.is_measured:
            found.append(f"Without effect on anything measured: {', '.join(self.without_effect)}. Leave them out.")
        for combination in self.inseparable:
            found.append(f"Cannot be told apart: {', '.join(combination)}. {_without_effect(combination)}")
        if names := ", ".join(self.at_bounds):
            found.append(f"At a bound: {names}. The data ask for more; widen it or doubt the model.")
        return found

    def save(self, path: str | Path) -> None:
        """Write values and bounds to a file as YAML, in the format of `ParameterDict` in `mujoco.sysid`."""
        # YAML 1.1 reads numbers with a point and without an exponent.
        yaml = lambda x: np.format_float_positional(x, trim="0").replace("inf", ".inf")  # noqa: E731
        bounds = self.coordinates.lower, self.coordinates.upper
        lower, upper = (self.coordinates.unravel(np.asarray(x)) for x in bounds)
        lines = []
        for name, value in self.values.items():
            parts = {"nominal": self.start[name], "min_value": lower[name], "max_value": upper[name], "value": value}
            lines += [f"{name}:", f"  name: {name}", "  frozen: false"]
            lines += [f"  {key}: [{', '.join(map(yaml, np.ravel(x).tolist()))}]" for key, x in parts.items()]
        write(path, "\n".join(lines) + "\n")


def statistics(
    coordinates: Coordinates,
    values: Float[np.ndarray, " dim"],
    squares: float,
    slope: Float[np.ndarray, "rows dim"],
    num_numbers: int,
    num_offsets: int,
) -> dict[str, Any]:
    """Return the fields of `Identification` that residuals at the end and their derivative tell, half widths as a vector.

    The derivative is by the values, orthogonal to the effect of the starts, which are `num_offsets` more unknowns; it is of the
    residuals, or has the same products. There are `num_numbers` measurements.
    """
    rounding = float(np.finfo(np.asarray(coordinates.nominal).dtype).eps)
    lengths = np.linalg.norm(slope, axis=0)
    width = np.asarray(coordinates.upper - coordinates.lower, float)
    effects = lengths * np.where(np.isfinite(width), width, np.maximum(np.abs(values), 1.0))
    is_felt = effects > np.sqrt(rounding) * effects.max(initial=0.0)
    _, sizes, right = np.linalg.svd(slope[:, is_felt] / lengths[is_felt], full_matrices=False)
    is_clear = sizes > max(_NOT_TOLD_APART, rounding**0.4) * sizes.max(initial=0.0)
    blurred = right[~is_clear]
    spread = np.where(is_clear, 1 / np.where(sizes > 0, sizes, 1.0), 0.0)[:, None] * right / lengths[is_felt]
    freedom = max(num_numbers - num_offsets - int(is_clear.sum()), 1)
    covariance = np.full((len(values), len(values)), np.nan)
    covariance[np.ix_(is_felt, is_felt)] = squares / freedom * spread.T @ spread
    lost = ~is_felt
    lost[np.flatnonzero(is_felt)[(blurred**2).sum(axis=0) > _NO_PART**2]] = True
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    covariance[lost, lost] = np.inf
    half_width = scipy.special.stdtrit(freedom, (1 + _LEVEL) / 2) * np.sqrt(np.diag(covariance))
    names = np.array(coordinates.names)
    return {
        "covariance": covariance,
        "half_width": half_width,
        "condition_number": float(sizes[0] / sizes[-1]) if sizes.size and sizes[-1] > 0 else np.inf,
        "without_effect": tuple(names[~is_felt].tolist()),
        "inseparable": _combinations(blurred, lengths[is_felt], values[is_felt], names[is_felt]),
    }


def exceeds_noise(rms: float, freedom: int, chance: float = CHANCE) -> bool:
    """Return whether residuals in units of the noise are larger than chance allows (chi-square)."""
    return bool(scipy.special.chdtrc(max(freedom, 1), rms**2 * max(freedom, 1)) < chance)


def _combinations(
    blurred: np.ndarray, lengths: np.ndarray, values: np.ndarray, names: np.ndarray
) -> tuple[dict[str, float], ...]:
    """Return directions without effect as relative changes of few numbers, the first by one per cent."""
    effects = lengths * np.where(values != 0, values, 1.0)
    found = []
    for row in simple(blurred / effects):
        # A small change of what is large can undo all that the large one of a small number does.
        is_part = [np.abs(one) > _SMALL_PART * np.abs(one).max() for one in (row, row * effects)]
        parts = np.flatnonzero(is_part[0] | is_part[1])
        found.append({str(names[i]): float(0.01 * row[i] / row[parts[0]]) for i in parts})
    return tuple(found)


def _without_effect(combination: dict[str, float]) -> str:
    """Say what change of numbers together has no effect, so that only what it leaves is told."""
    changes = " with ".join(f"{100 * share:+.2g} % of {name}" for name, share in combination.items())
    return f"{changes} changes nothing measured."


def _partners(told: dict[str, Any], coordinates: Coordinates) -> list[str]:
    """Return for each number the others with which its error goes, at a correlation of more than 0.9."""
    covariance, names = told["covariance"], coordinates.names
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        related = np.abs(covariance / np.outer(errors, errors)) > _TIED
    np.fill_diagonal(related, False)
    for combination in told["inseparable"]:
        index = [names.index(name) for name in combination]
        related[np.ix_(index, index)] = ~np.eye(len(index), dtype=bool)
    return [", ".join(np.array(names)[row].tolist()) for row in related]


def durations(seconds: tuple[float, float]) -> str:
    """Return times, about and at most, in words: as a range, or as one if they are equal; a second at least."""
    least, most = (duration(max(x, 1.0)) for x in seconds)
    (number, unit), other = least.split(" "), most.split(" ")[1]
    return f"about {least}" if least == most else f"{number if unit == other else least} to {most}"


def _percent(shares: np.ndarray) -> str:
    low, high = ("<0.01" if x < 0.01 else f"{x:.1g}" for x in (shares.min(), shares.max()))
    return high if low == high else f"{low}–{high}"


def _digits(value: float, half_width: float) -> str:
    """Return a value to the second digit of its interval."""
    if not (np.isfinite(half_width) and half_width > 0 and value):
        return format_number(value)
    digits = int(np.clip(np.ceil(np.log10(abs(value) / half_width)) + 2, 2, 9))
    return f"{value:.{digits}g}"
