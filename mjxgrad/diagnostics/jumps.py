r"""Where along a path a quantity jumps, told from where it is merely steep.

On a grid a jump and a steep slope look alike. They differ under refinement: within ever shorter intervals the change of a
slope shrinks with the length, that of a jump stays. So the intervals with the largest changes are divided, the part that
holds the most of the change is divided again, and what still stands after some rounds is a jump.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

# What a division may leave of a change that is a jump; a slope keeps one part in many, a square root the root of that.
_KEPT = 0.5


class Jumps(eqx.Module):
    """The jumps of a quantity along a path, in their order; sizes are Euclidean norms over the outcome.

    Attributes:
        parameters: of the grid.
        values: there.
        places: of the jumps.
        before: the value just before each.
        after: the value just after each.
        steepest: the largest change per parameter of the intervals that were divided and hold no jump; zero without any.
        scale: largest size of a value on the grid.
        resolution: length to which intervals were divided: a slope over less than this counts as a jump.
        num_finite: grid points whose value is finite; beside others no jump is looked for.
    """

    parameters: Float[np.ndarray, " points"]
    values: Float[np.ndarray, "points *outcome"]
    places: Float[np.ndarray, " jumps"]
    before: Float[np.ndarray, "jumps *outcome"]
    after: Float[np.ndarray, "jumps *outcome"]
    steepest: float
    scale: float
    resolution: float
    num_finite: int

    @property
    def sizes(self) -> Float[np.ndarray, " jumps"]:
        """Of the jumps, in the quantity's units."""
        return _norm(self.after - self.before)

    @property
    def relative(self) -> Float[np.ndarray, " jumps"]:
        """Sizes over the larger of the values before and after: 1 where it falls to zero, √2 where it turns by a right angle."""
        larger = np.maximum(_norm(self.before), _norm(self.after))
        return self.sizes / np.where(larger > 0, larger, 1.0)

    @property
    def largest(self) -> int:
        """Which jump is the largest in size; −1 without any."""
        return int(np.argmax(self.sizes)) if len(self.places) else -1

    @property
    def share(self) -> float:
        """Part of the quantity's total variation that is jumps; zero if it does not vary."""
        steps = _norm(np.diff(self.values, axis=0))
        total = float(steps[np.isfinite(steps)].sum())
        return min(1.0, float(self.sizes.sum()) / total) if total > 0 else 0.0


def jumps_along(
    function: Callable[[Float[np.ndarray, " points"]], Float[np.ndarray, "points *outcome"]],
    interval: tuple[float, float],
    *,
    num_points: int = 256,
    num_candidates: int = 16,
    num_refinements: int = 6,
    smallest: float = 1e-4,
) -> Jumps:
    """Find the jumps of a quantity along a one-parameter path.

    Of two jumps between neighbouring points of the grid the larger one is found.

    Args:
        function: from many parameters at once to their values, such as `jax.jit(jax.vmap(f))` or a loop over C MuJoCo. Called
            with `num_points` parameters each time, so that it is compiled once.
        interval: of the parameter.
        num_points: of the grid, and of each refinement; a multiple of `num_candidates`.
        num_candidates: intervals that are refined, those with the largest changes: the most jumps that can be found.
        num_refinements: rounds, each of which divides the intervals into `num_points / num_candidates + 1` parts.
        smallest: jump that counts, as a share of the largest value on the grid.

    Returns:
        The jumps, and the grid.

    Raises:
        ValueError: if the interval is empty, `num_points` is not a multiple of `num_candidates` of at least that many and two,
            there is no round, or the function does not return one value per parameter.
    """
    low, high = interval
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"interval must be two finite numbers, the smaller one first, got {interval}")
    if num_candidates < 1 or num_points < 2 or num_points % num_candidates:
        raise ValueError(
            f"num_points must be a multiple of num_candidates and at least 2, got {num_points} and {num_candidates}"
        )
    if num_refinements < 1:
        raise ValueError(f"num_refinements must be at least 1, got {num_refinements}: without one a slope is a jump")
    grid = np.linspace(low, high, num_points)
    values = _evaluate(function, grid)
    ends, at_ends, changes, is_jump = _refine(function, grid, values, num_candidates, num_refinements)
    finite = np.isfinite(values).reshape(num_points, -1).all(axis=1)
    scale = float(_norm(values[finite]).max(initial=0.0))
    is_jump &= changes > smallest * scale
    widths = ends[:, 1] - ends[:, 0]
    slopes = np.where(is_jump | (changes < 0), 0.0, changes / np.where(widths > 0, widths, 1.0))
    order = np.flatnonzero(is_jump)[np.argsort(ends[is_jump, 0])]
    parts = num_points // num_candidates + 1
    return Jumps(
        parameters=grid,
        values=values,
        places=ends[order].mean(axis=1),
        before=at_ends[order, 0],
        after=at_ends[order, 1],
        steepest=float(slopes.max(initial=0.0)),
        scale=scale,
        resolution=(high - low) / (num_points - 1) / parts**num_refinements,
        num_finite=int(finite.sum()),
    )


def _refine(
    function: Callable, grid: np.ndarray, values: np.ndarray, num_candidates: int, num_refinements: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Bool[np.ndarray, " candidates"]]:
    """Return the intervals that were divided, the values at their ends, their last changes, and which of these stayed."""
    steps = _changes(values)
    chosen = np.argsort(-steps, kind="stable")[:num_candidates]
    ends = np.stack([grid[chosen], grid[chosen + 1]], axis=1)
    at_ends = np.stack([values[chosen], values[chosen + 1]], axis=1)
    changes, stayed = steps[chosen], np.zeros(len(chosen), bool)
    num_inner = len(grid) // num_candidates
    inner = np.arange(1, num_inner + 1) / (num_inner + 1)
    rows = np.arange(len(chosen))
    for _ in range(num_refinements):
        between = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * inner
        # The grid has one interval less than points, so a last row may be missing; the batch keeps its length all the same.
        batch = np.resize(between.ravel(), len(grid))
        found = _evaluate(function, batch)[: between.size].reshape(*between.shape, *values.shape[1:])
        places = np.concatenate([ends[:, :1], between, ends[:, 1:]], axis=1)
        all_values = np.concatenate([at_ends[:, :1], found, at_ends[:, 1:]], axis=1)
        parts = np.stack([_changes(row) for row in all_values])
        most = parts.argmax(axis=1)
        ends = np.stack([places[rows, most], places[rows, most + 1]], axis=1)
        at_ends = np.stack([all_values[rows, most], all_values[rows, most + 1]], axis=1)
        stayed = parts[rows, most] > _KEPT * changes
        changes = parts[rows, most]
    return ends, at_ends, changes, stayed


def _evaluate(function: Callable, parameters: np.ndarray) -> np.ndarray:
    values = np.asarray(function(parameters), float)
    if values.shape[:1] != parameters.shape:
        raise ValueError(
            f"function must return one value per parameter, a leading axis of {len(parameters)}, got shape {values.shape}"
        )
    return values


def _changes(values: np.ndarray) -> np.ndarray:
    """Return the sizes of the changes between neighbours, −1 where one of the two is not finite."""
    steps = _norm(np.diff(values, axis=0))
    return np.where(np.isfinite(steps), steps, -1.0)


def _norm(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).sum(axis=tuple(range(1, values.ndim))))
