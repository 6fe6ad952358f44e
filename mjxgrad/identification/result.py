r"""What was found, how surely, and what the recordings cannot tell.

With residuals $r$ in units of the noise and $J = \partial r / \partial \theta$ at the end, $n$ numbers and $p$ unknowns,
$s^2 = r^T r / (n - p)$ estimates how much larger the noise is than was said, and the covariance of the parameters is
$s^2 (J^T J)^{-1}$. It holds where the model is right, the noise independent, and residuals almost linear over the interval. What
a singular value decomposition of $J$ with columns of length 1 shows to be of no consequence has no interval: it is named.

References:
    Bates, Watts. Nonlinear Regression Analysis and Its Applications. Wiley 1988, chapters 2 and 3.
"""

import dataclasses
import enum
from pathlib import Path

import jax
import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from mjxgrad._text import format_number
from mjxgrad.identification.parameters import Coordinates
from mjxgrad.scene import Scene

_LEVEL = 0.95
_SMALL_PART = 0.05  # of a combination: what takes part in it with less is not named
_NOT_TOLD_APART = 1e-6  # of the clearest direction: the data would have to be a million times better along this one
_RELATED = 0.5  # of the correlation of residuals: intervals are then too narrow by √3
_REMOVED = 1e-3  # of the residuals at the start: what is left is that of numbers computed in another way
_ENOUGH = 30  # numbers: among fewer, noise alone is as correlated once in a hundred times
_CHANCE = 1e-4  # that residuals as large are noise
_NO_PART = 1e-4  # of a direction that is not determined: what has no more is determined all the same


class Stopped(enum.Enum):
    """Why a search ended."""

    CONVERGED = "converged"
    STALLED = "stalled"
    STEPS = "max_steps reached"


@dataclasses.dataclass(frozen=True)
class Statistics:
    """What the residuals and their derivative at the end say; see `Identification` for the fields."""

    covariance: Float[np.ndarray, "dim dim"]
    half_width: Float[np.ndarray, " dim"]
    condition_number: float
    without_effect: tuple[str, ...]
    inseparable: tuple[dict[str, float], ...]


@dataclasses.dataclass(frozen=True)
class Identification:
    """Parameters from recorded motions.

    Attributes:
        values: by name.
        start: the nominal values, by name.
        half_width: of the 95 % intervals, by name; infinite for what the recordings do not determine.
        covariance: of all numbers in the order of `names`; infinite on the diagonal where they are not determined.
        names: of all numbers, `inertia[3]` for one of several.
        condition_number: of J with columns of length 1. Beyond a hundred or so single intervals are much wider than combinations.
        without_effect: names on which no measurement depends.
        inseparable: combinations that no measurement can tell apart: each says by how much several numbers may change together,
            relative to their values, without any effect.
        at_bounds: names that ended at a bound: the data ask for more, and their intervals mean little.
        rms: root mean square of the residuals in units of the noise, before and after; about 1 if noise and model are right.
        has_noise: whether the recordings say the noise of every signal.
        held_out_rms: the same of the recordings that were held out; None without any.
        offsets: of the starts, one array (windows, 2 nv) for each scene; None unless asked for.
        correlation: of residuals with those of the same signal one time later. About 0 if all that is left is independent noise.
        removable: share of the sum of squares that the derivative at the end could still remove within the bounds. About 0
            at a minimum of a smooth motion.
        num_numbers: measured numbers that took part.
        num_steps: of the search.
        stopped: why it ended.
        scenes: with the values found.
        coordinates: bounds and names, for saving.
        units: by name.
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
    offsets: tuple[np.ndarray, ...] | None
    correlation: float
    removable: float
    num_numbers: int
    num_steps: int
    stopped: Stopped
    scenes: tuple[Scene, ...]
    coordinates: Coordinates
    units: dict[str, str]

    @property
    def scene(self) -> Scene:
        """The first, or only, scene, with the values found."""
        return self.scenes[0]

    def summary(self) -> str:
        """Describe the result in text: the values with their intervals, then what to beware of."""
        count = len(self.names)
        head = f"{count} number{'s' * (count > 1)} from {self.num_numbers} measured ones in {self.num_steps} steps"
        rms = f"Residuals, in units of the noise: {self.rms[0]:.3g} at the start, {self.rms[1]:.3g} now"
        if self.held_out_rms is not None:
            rms += f"; held out: {self.held_out_rms[0]:.3g} and {self.held_out_rms[1]:.3g}"
        return "\n".join(
            [
                f"{head}, {self.stopped.value}.",
                f"{rms}.",
                "",
                *self._table(),
                *[f"\n{line}" for line in self.warnings()],
            ]
        )

    def rows(self) -> list[tuple[str, ...]]:
        """Return the values as a table of text, its head first: name and unit, value, interval, start, bounds."""
        parts = (self.values, self.half_width, self.start)
        columns = [np.concatenate([np.ravel(part[name]) for name in self.values]) for part in parts]
        bounds = zip(on_host(self.coordinates.lower), on_host(self.coordinates.upper), strict=True)
        rows = [("parameter", "found", "± 95 %", "start", "bounds")]
        for name, found, half, start, (low, high) in zip(self.names, *columns, bounds, strict=True):
            unit = self.units.get(name.split("[")[0], "")
            shown = (_digits(found, half), f"{half:.2g}" if np.isfinite(half) else "unknown", format_number(start))
            rows.append(
                (f"{name} ({unit})" if unit else name, *shown, f"{format_number(low)} to {format_number(high)}")
            )
        return rows

    def _table(self) -> list[str]:
        rows = self.rows()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]

    def warnings(self) -> list[str]:
        """Say what to beware of, a sentence or two each: a search that stalled, numbers that cannot be told."""
        found = []
        if self.stopped is Stopped.STALLED:
            found.append(
                f"Stalled: by the derivative {100 * self.removable:.2g} % of the sum of squares could go, but no step helps. "
                "Motions that jump do that: take onset=mg.Onset(), shorter windows or another start; doubt the intervals."
            )
        if self.has_noise and exceeds_noise(self.rms[1], self.num_numbers - len(self.names)):
            found.append(
                f"Residuals are {self.rms[1]:.3g} times the noise that was said, which is more than chance: the motion of the "
                "scene is not the recorded one, and values may be off by more than their intervals. Try free_start=True, shorter "
                "windows (recording.cut), more parameters or num_points, or say the noise as it is."
            )
        if self.correlation > _RELATED and self.rms[1] > _REMOVED * self.rms[0] and self.num_numbers >= _ENOUGH:
            starts = "" if self.offsets is not None else "The starts may be noisy: free_start=True finds them, too. "
            found.append(
                f"Residuals follow one another (correlation {self.correlation:.2f} from one time to the next), so something is "
                f"not as in the scene. {starts}Values may be off by more than their intervals, which take independent noise."
            )
        if self.without_effect:
            found.append(f"Without effect on anything measured: {', '.join(self.without_effect)}. Leave them out.")
        for combination in self.inseparable:
            changes = " with ".join(f"{100 * share:+.2g} % of {name}" for name, share in combination.items())
            found.append(f"Cannot be told apart: {', '.join(combination)}. {changes} changes nothing measured.")
        if self.at_bounds:
            found.append(
                f"At a bound: {', '.join(self.at_bounds)}. The data ask for more; widen it, or doubt the model."
            )
        return found

    def save(self, path: str | Path) -> None:
        """Write values and bounds as YAML, as a `ParameterDict` of `mujoco.sysid` is saved and loaded.

        Args:
            path: of the file.
        """
        lower, upper = (
            self.coordinates.unravel(np.asarray(x)) for x in (self.coordinates.lower, self.coordinates.upper)
        )
        lines = []
        for name, value in self.values.items():
            parts = {"nominal": self.start[name], "min_value": lower[name], "max_value": upper[name], "value": value}
            lines += [f"{name}:", f"  name: {name}", "  frozen: false"]
            lines += [f"  {key}: [{', '.join(map(_yaml, np.ravel(x).tolist()))}]" for key, x in parts.items()]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def statistics(
    coordinates: Coordinates,
    values: Float[np.ndarray, " dim"],
    residual: Float[np.ndarray, " numbers"],
    slope: Float[np.ndarray, "numbers dim"],
    num_numbers: int,
    num_offsets: int,
) -> Statistics:
    """Return intervals and what the recordings cannot tell.

    Args:
        coordinates: names and bounds.
        values: at the end.
        residual: there, in units of the noise.
        slope: its derivative by the values, what starts explain taken out.
        num_numbers: of residuals that are measurements.
        num_offsets: unknowns beside the parameters.
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
    variance = residual @ residual / freedom
    covariance = np.full((len(values), len(values)), np.nan)
    covariance[np.ix_(is_felt, is_felt)] = variance * spread.T @ spread
    lost = ~is_felt
    lost[np.flatnonzero(is_felt)[(blurred**2).sum(axis=0) > _NO_PART**2]] = True
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    covariance[lost, lost] = np.inf
    half_width = scipy.special.stdtrit(freedom, (1 + _LEVEL) / 2) * np.sqrt(np.diag(covariance))
    return Statistics(
        covariance,
        half_width,
        float(sizes[0] / sizes[-1]) if sizes.size and sizes[-1] > 0 else np.inf,
        tuple(name for name, felt in zip(coordinates.names, is_felt, strict=True) if not felt),
        _combinations(blurred / lengths[is_felt], values[is_felt], np.array(coordinates.names)[is_felt]),
    )


def exceeds_noise(rms: float, freedom: int) -> bool:
    """Return whether residuals are larger than the noise, in units of which they are, by more than chance (chi-square)."""
    return bool(scipy.special.chdtrc(max(freedom, 1), rms**2 * max(freedom, 1)) < _CHANCE)


def _combinations(blurred: np.ndarray, values: np.ndarray, names: np.ndarray) -> tuple[dict[str, float], ...]:
    """Return directions without effect as relative changes, each of as few numbers as possible, the first by one per cent."""
    if not len(blurred):
        return ()
    relative = blurred / np.where(values != 0, values, 1.0)
    *_, order = scipy.linalg.qr(relative, mode="economic", pivoting=True)
    relative = np.linalg.solve(relative[:, order[: len(blurred)]], relative)
    found = []
    for row in relative:
        parts = np.flatnonzero(np.abs(row) > _SMALL_PART * np.abs(row).max())
        found.append({str(names[i]): float(0.01 * row[i] / row[parts[0]]) for i in parts})
    return tuple(found)


def _digits(value: float, half_width: float) -> str:
    """Return a value to the second digit of its interval."""
    if not (np.isfinite(half_width) and half_width > 0 and value):
        return format_number(value)
    digits = int(np.clip(np.ceil(np.log10(abs(value) / half_width)) + 2, 2, 9))
    return f"{value:.{digits}g}"


def _yaml(number: float) -> str:
    """Return a number as YAML 1.1 reads it: with a point, also before an exponent."""
    if not np.isfinite(number):
        return ".inf" if number > 0 else "-.inf"
    mantissa, exponent, power = repr(float(number)).partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.0") + exponent + power


def on_host(tree):
    """Return arrays of numpy in double precision."""
    return jax.tree.map(lambda x: np.asarray(x, float), tree)
