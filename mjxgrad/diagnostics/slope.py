r"""Is a derivative the slope? Derivatives of an outcome against the slope of the simulated outcome itself.

A simulated outcome depends on where within a time step each contact begins. Along a parameter it is therefore a smooth
trend plus a sawtooth: a short difference quotient meets a tooth's flank, which is what the derivative of the discrete
map gives, while the motion, and every cost averaged over a little noise, follows the trend. Here the outcome is
simulated at many parameters over an interval that holds many teeth, and the trend's slope is compared with the mean of
derivatives over the same interval.

Both are averages with the same weight. A straight line fitted with weights $W(u) = 1 - u^2$, $u \in (-1, 1)$ being the
place in the interval, has the slope

$$\frac{\int u W f}{\int u^2 W} = \int k f', \qquad k(u) = \tfrac{15}{16} (1 - u^2)^2,$$

by parts, since $k' = -\tfrac{15}{4} u W$ and $k$ vanishes at the ends. So wherever the outcome is smooth the slope equals
the mean of its derivative with weight $k$, whatever the curvature; they differ by what derivatives do not see, the
jumps. The same smooth weight averages over teeth: a cut tooth at an end counts for nothing.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

Simulate = Callable[[Float[Array, ""], str], Float[Array, "*outcome"]]

# Fewest phases from which four local slopes and eight blocks for the error bar can be had, with four points each.
_FEWEST_PHASES = 32
_NUM_WINDOWS = 4
_POINTS_PER_BLOCK = 4
_MOST_BLOCKS = 24
_ROUNDINGS = 1e3  # of the outcome's precision, that many steps may add up


class SlopeComparison(eqx.Module):
    """Derivatives beside the slope; units are those of the outcome over those of the parameter.

    Where fewer than 32 phases are finite, numbers are NaN, and judgements (`is_close`, `is_off`, `is_resolved`) are False.

    Attributes:
        gradients: names of the derivatives, in the order of their axis.
        parameters: at which the outcome was simulated, increasing.
        outcomes: simulated.
        derivatives: at each phase.
        slope: of the simulated outcome, fitted over the interval.
        slope_error: its standard error. Conservative where many phases share a tooth, for their errors then cancel.
        mean: of each derivative over the interval, weighted as the slope is.
        mean_error: its standard error.
        spread: standard deviation of each derivative over the phases.
        local_slopes: of the outcome over each quarter of the interval.
        num_teeth: how often the outcome crosses its own trend, halved: about the number of teeth in the interval.
        num_finite: phases at which outcome and derivatives are finite; only these count.
        resolution: what rounding of the outcome leaves of a slope; smaller errors are none.
    """

    gradients: tuple[str, ...] = eqx.field(static=True)
    parameters: Float[np.ndarray, " phases"]
    outcomes: Float[np.ndarray, "phases *outcome"]
    derivatives: Float[np.ndarray, "gradients phases *outcome"]
    slope: Float[np.ndarray, "*outcome"]
    slope_error: Float[np.ndarray, "*outcome"]
    mean: Float[np.ndarray, "gradients *outcome"]
    mean_error: Float[np.ndarray, "gradients *outcome"]
    spread: Float[np.ndarray, "gradients *outcome"]
    local_slopes: Float[np.ndarray, "windows *outcome"]
    num_teeth: Float[np.ndarray, "*outcome"]
    num_finite: Int[np.ndarray, "*outcome"]
    resolution: Float[np.ndarray, "*outcome"]

    @property
    def standard_error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Of `error`: both parts as if independent, which they nearly are, one being about jumps and one about flanks."""
        return np.hypot(self.mean_error, self.slope_error)

    @property
    def irregularity(self) -> Float[np.ndarray, "*outcome"]:
        """How far the slopes of the quarters are off a straight line through them, over `scale`.

        Small where a slope exists to be compared with; of order one where the outcome is torn, by chaos or by real
        discontinuities, or where a quarter holds too few teeth.
        """
        place = np.arange(_NUM_WINDOWS) - (_NUM_WINDOWS - 1) / 2
        centred = self.local_slopes - self.local_slopes.mean(axis=0)
        tilt = np.tensordot(place, centred, axes=1) / (place**2).sum()
        rest = centred - place.reshape(-1, *[1] * tilt.ndim) * tilt
        size = np.abs(rest).max(axis=0)
        return np.asarray(np.where(size > _NUM_WINDOWS * self.resolution, size, 0 * size) / self.scale)

    @property
    def error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Mean of each derivative less the slope."""
        return self.mean - self.slope

    @property
    def scale(self) -> Float[np.ndarray, "*outcome"]:
        """What errors are measured by: the larger of the slope and the error of the first derivative named."""
        # Where both are nothing but rounding, no error is to look large beside it.
        return np.asarray(np.maximum(np.maximum(np.abs(self.slope), np.abs(self.error[0])), self.resolution))

    @property
    def relative_error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Size of `error` beyond rounding, over `scale`."""
        size = np.abs(self.error)
        return np.where(size > self.resolution, size, 0 * size) / self.scale

    def is_close(self, tolerance: float = 0.05) -> Bool[np.ndarray, "gradients *outcome"]:
        """Say where the mean of a derivative is the slope to within `tolerance` times `scale`."""
        return self.relative_error <= tolerance

    def is_off(self, tolerance: float = 0.05) -> Bool[np.ndarray, "gradients *outcome"]:
        """Say where it is not, beyond two standard errors. What is neither close nor off needs more rollouts."""
        return np.abs(self.error) - 2 * self.standard_error > np.maximum(tolerance * self.scale, self.resolution)

    def is_resolved(self, tolerance: float = 0.05) -> Bool[np.ndarray, "*outcome"]:
        """Say where the slope is known well enough to judge by: its standard error is below `tolerance` times `scale`."""
        return np.asarray(self.slope_error <= np.maximum(tolerance * self.scale, self.resolution))


def derivative_against_slope(
    simulate: Simulate,
    interval: tuple[float, float],
    *,
    num_phases: int = 64,
    gradients: Sequence[str] = ("discrete", "slope"),
) -> SlopeComparison:
    """Compare derivatives of a simulated outcome with the slope of the outcome itself.

    Args:
        simulate: from a parameter and the name of a gradient to the outcome, of any shape; for instance positions at
            several times of `mg.rollout(..., gradient=gradient)` from a start that depends on the parameter. Its value must
            not depend on the name. Compiled once per name for all phases; it is compiled anew for each function object,
            unless it is a pytree (`jax.tree_util.Partial`, `eqx.Module`) whose arrays alone differ.
        interval: of the parameter. Long enough that the first contact moves through ten time steps or more, and short
            enough that the motion stays of one kind.
        num_phases: simulated rollouts, spread evenly but for a jitter that keeps them from falling in step with the teeth.
        gradients: names to hand to `simulate`. The first is what errors of the others are measured beside.

    Returns:
        Slope, means and their errors.

    Raises:
        ValueError: if the interval is empty, `num_phases` is below 32 or no gradient is named.
    """
    names = tuple(gradients)
    if not names:
        raise ValueError("gradients must name at least one derivative, got none")
    parameters = phases(interval, num_phases)
    sampled = [_sample(simulate, jnp.asarray(parameters), name) for name in names]
    return compare_to_slope(parameters, sampled[0][0], [derivative for _, derivative in sampled], names)


def phases(interval: tuple[float, float], num_phases: int) -> Float[np.ndarray, " phases"]:
    """Give parameters spread over an interval, one in each of equal parts, at a random place in it.

    Evenly spaced ones might all meet the same phase of the time step, and so do regular displacements (multiples of the
    golden ratio) for some lengths of tooth. The places are the same in every call, and increase.

    Raises:
        ValueError: if the interval is empty or `num_phases` is below 32.
    """
    low, high = interval
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"interval must be two finite numbers, the smaller one first, got {interval}")
    if num_phases < _FEWEST_PHASES:
        raise ValueError(f"num_phases must be at least {_FEWEST_PHASES}, got {num_phases}: fewer give no error bar")
    places = np.random.default_rng(0).uniform(size=num_phases)
    return low + (high - low) * (np.arange(num_phases) + places) / num_phases


def compare_to_slope(
    parameters: ArrayLike,
    outcomes: ArrayLike,
    derivatives: Sequence[ArrayLike],
    gradients: Sequence[str] = ("discrete", "slope"),
) -> SlopeComparison:
    """Compare derivatives with the slope, from what was simulated elsewhere.

    Args:
        parameters: increasing; about evenly spaced, as `phases` gives them.
        outcomes: at each parameter.
        derivatives: for each gradient, one per outcome.
        gradients: their names.

    Returns:
        Slope, means and their errors.

    Raises:
        ValueError: if shapes do not fit, parameters do not increase or there are fewer than 32.
    """
    x, y = np.asarray(parameters, float), np.asarray(outcomes)
    y, epsilon = y.astype(float), np.finfo(y.dtype if np.issubdtype(y.dtype, np.floating) else float).eps
    slopes = np.array([np.asarray(one, float) for one in derivatives])
    if slopes.shape != (len(gradients), *y.shape) or x.shape != y.shape[:1]:
        raise ValueError(
            "derivatives must hold one array of the outcomes' shape, whose first axis is that of the parameters, for "
            f"each of {len(gradients)} gradients, got {slopes.shape} beside {y.shape} and {x.shape}"
        )
    if len(x) < _FEWEST_PHASES or not (np.diff(x) > 0).all():
        raise ValueError(f"parameters must be at least {_FEWEST_PHASES} and increase, got {len(x)}")
    width = (x[-1] - x[0]) * len(x) / (len(x) - 1)
    place = (x - (x[0] + x[-1]) / 2) / (width / 2)
    flat, flat_slopes = y.reshape(len(x), -1), slopes.reshape(len(slopes), len(x), -1)
    columns = [_column(place, flat[:, j], flat_slopes[:, :, j]) for j in range(flat.shape[1])]
    parts = [np.array([column[i] for column in columns]) for i in range(len(columns[0]))]
    slope, slope_error, local_slopes, num_teeth, mean, mean_error, spread, num_finite = (
        np.moveaxis(part, 0, -1).reshape((*part.shape[1:], *y.shape[1:])) for part in parts
    )
    # Of an outcome that is zero throughout: not zero, for errors are divided by it.
    size = np.maximum(np.nanmax(np.abs(y), axis=0, initial=0), np.finfo(float).tiny)
    return SlopeComparison(
        gradients=tuple(gradients),
        parameters=x,
        outcomes=y,
        derivatives=slopes,
        slope=np.asarray(slope * 2 / width),
        slope_error=np.asarray(slope_error * 2 / width),
        mean=mean,
        mean_error=mean_error,
        spread=spread,
        local_slopes=local_slopes * 2 / width,
        num_teeth=num_teeth,
        num_finite=num_finite.astype(int),
        resolution=np.asarray(_ROUNDINGS * epsilon * size / width),
    )


@eqx.filter_jit
def _sample(simulate: Simulate, parameters: Float[Array, " phases"], gradient: str) -> tuple[Array, Array]:
    def one(parameter: Float[Array, ""]) -> tuple[Array, Array]:
        # Forward mode: one parameter, many outcomes.
        return jax.jvp(lambda x: simulate(x, gradient), (parameter,), (jnp.ones_like(parameter),))

    return jax.vmap(one)(parameters)


def _column(u: np.ndarray, y: np.ndarray, slopes: Float[np.ndarray, "gradients phases"]) -> tuple:
    """Compare for a single outcome, the interval being (-1, 1)."""
    is_finite = np.isfinite(y) & np.isfinite(slopes).all(axis=0)
    count = int(is_finite.sum())
    if count < _FEWEST_PHASES:
        nothing = np.full(len(slopes), np.nan)
        return np.nan, np.nan, np.full(_NUM_WINDOWS, np.nan), np.nan, nothing, nothing, nothing, count
    u, y, slopes = u[is_finite], y[is_finite], slopes[:, is_finite]
    weight = 1 - u**2
    lever = _lever(u, weight)
    # A trend of degree 3, for curvature is no error of the slope.
    rest = _residuals(u, y, weight, 3)
    slope_error = _clustered(lever * rest)
    kernel = weight**2 / (weight**2).sum()
    errors = np.array([_clustered(kernel * _residuals(u, one, weight**2, 1)) for one in slopes])
    teeth = np.count_nonzero(np.diff(np.signbit(rest))) / 2
    return (
        lever @ y,
        slope_error,
        _local_slopes(u, y),
        teeth,
        slopes @ kernel,
        errors,
        slopes.std(axis=1, ddof=1),
        count,
    )


def _lever(u: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Give the numbers whose product with an outcome is the slope of the weighted straight line."""
    centred = u - (weight @ u) / weight.sum()
    return weight * centred / (weight @ centred**2)


def _residuals(u: np.ndarray, y: np.ndarray, weight: np.ndarray, degree: int) -> np.ndarray:
    """Return what a polynomial trend leaves, each as if its own point had not been fitted."""
    root = np.sqrt(np.maximum(weight, 0))
    basis, _ = np.linalg.qr(root[:, None] * np.polynomial.legendre.legvander(u, degree))
    leverage = (basis**2).sum(axis=1)
    fitted = basis @ (basis.T @ (root * y))
    return (y - fitted / np.where(root > 0, root, 1)) / (1 - leverage)


def _clustered(terms: np.ndarray) -> float:
    """Give the standard error of a sum of weighted residuals, those of a block of neighbours taken as one.

    Neighbours on one tooth err together, so single residuals would understate the error.

    References:
        Bell, McCaffrey. Bias reduction in standard errors for linear regression with multi-stage samples. Survey
        Methodology 28, 2002 (the jackknifed residuals).
    """
    blocks = np.array_split(terms, min(_MOST_BLOCKS, len(terms) // _POINTS_PER_BLOCK))
    sums = np.array([block.sum() for block in blocks])
    return float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)))


def _local_slopes(u: np.ndarray, y: np.ndarray) -> Float[np.ndarray, " windows"]:
    found = []
    for at, value in zip(np.array_split(u, _NUM_WINDOWS), np.array_split(y, _NUM_WINDOWS), strict=True):
        half = (at[-1] - at[0]) / 2 * len(at) / (len(at) - 1)
        found.append(_lever(at, 1 - ((at - (at[0] + at[-1]) / 2) / half) ** 2) @ value)
    return np.array(found)
