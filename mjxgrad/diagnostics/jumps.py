r"""Jumps of a quantity along a path, distinguished from steep slopes.

On a grid a jump and a steep slope look alike, but they differ under refinement. The change of a slope shrinks with the
interval, the change of a jump does not. So the intervals with the largest changes are divided, and within each the part
with the largest change is divided again. A change that remains after some rounds is a jump.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

# A jump keeps at least this share of its change in a division. A slope keeps one part in many, a square root its root.
_KEPT = 0.5


class Jumps(eqx.Module):
    """The jumps of a quantity along a path, in order; sizes are Euclidean norms over the outcome.

    Attributes:
        places: parameters at which the jumps are.
        before: the value just before each.
        after: the value just after each.
    """

    places: Float[np.ndarray, " jumps"]
    before: Float[np.ndarray, "jumps *outcome"]
    after: Float[np.ndarray, "jumps *outcome"]

    @property
    def sizes(self) -> Float[np.ndarray, " jumps"]:
        """The sizes of the jumps, in the quantity's units."""
        return _norm(self.after - self.before)

    @property
    def largest(self) -> int:
        """The index of the largest jump; −1 if there is none."""
        return int(np.argmax(self.sizes)) if len(self.places) else -1


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

    Between two neighbouring points of the grid only the largest jump is found, and only where both values are finite.
    A slope over less than the finest interval counts as a jump.

    Args:
        function: from many parameters at once to their values, such as `jax.jit(jax.vmap(f))` or a loop over C MuJoCo. Every
            call has `num_points` parameters, so that one compilation suffices.
        interval: first and last parameter.
        num_points: number of points of the grid and of each refinement; a multiple of `num_candidates`.
        num_candidates: number of intervals to refine, those with the largest changes; also the largest number of jumps.
        num_refinements: number of rounds; each divides the intervals into `num_points / num_candidates + 1` parts.
        smallest: smallest jump that counts, as a share of the largest value on the grid.

    Returns:
        The jumps.

    Raises:
        ValueError: if the interval is empty, `num_points` is not a multiple of `num_candidates` and at least two,
            `num_refinements` is below 1, or the function does not return one value per parameter.
    """
    low, high = interval
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"interval must be two finite numbers, the smaller one first, got {interval}")
    if num_candidates < 1 or num_points < 2 or num_points % num_candidates:
        raise ValueError(f"num_points must be a multiple of num_candidates, got {num_points} and {num_candidates}")
    if num_refinements < 1:
        raise ValueError(f"num_refinements must be at least 1, got {num_refinements}: without one a slope is a jump")
    grid = np.linspace(low, high, num_points)
    values = _evaluate(function, grid)
    steps = _changes(values)
    chosen = np.argsort(-steps, kind="stable")[:num_candidates]
    ends, at_ends = (np.stack([of[chosen], of[chosen + 1]], axis=1) for of in (grid, values))
    changes, is_jump, rows = steps[chosen], np.zeros(len(chosen), bool), np.arange(len(chosen))
    inner = np.linspace(0, 1, num_points // num_candidates + 2)[1:-1]
    for _ in range(num_refinements):
        between = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * inner
        # The grid has one interval less than points, so a last row may be missing; the batch keeps its length.
        batch = np.resize(between.ravel(), num_points)
        found = _evaluate(function, batch)[: between.size].reshape(*between.shape, *values.shape[1:])
        places = np.concatenate([ends[:, :1], between, ends[:, 1:]], axis=1)
        all_values = np.concatenate([at_ends[:, :1], found, at_ends[:, 1:]], axis=1)
        parts = np.stack([_changes(row) for row in all_values])
        most = parts.argmax(axis=1)
        ends, at_ends = (np.stack([of[rows, most], of[rows, most + 1]], axis=1) for of in (places, all_values))
        is_jump, changes = parts[rows, most] > _KEPT * changes, parts[rows, most]
    finite = np.isfinite(values).reshape(num_points, -1).all(axis=1)
    is_jump &= changes > smallest * _norm(values[finite]).max(initial=0.0)
    order = np.flatnonzero(is_jump)[np.argsort(ends[is_jump, 0])]
    return Jumps(ends[order].mean(axis=1), at_ends[order, 0], at_ends[order, 1])


def _evaluate(function: Callable, parameters: np.ndarray) -> np.ndarray:
    values = np.asarray(function(parameters), float)
    if values.shape[:1] != parameters.shape:
        raise ValueError(f"function must return one value per parameter, {len(parameters)}, got shape {values.shape}")
    return values


def _changes(values: np.ndarray) -> np.ndarray:
    """Return the sizes of the changes between neighbours, −1 where one of the two is not finite."""
    steps = _norm(np.diff(values, axis=0))
    return np.where(np.isfinite(steps), steps, -1.0)


def _norm(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).sum(axis=tuple(range(1, values.ndim))))
