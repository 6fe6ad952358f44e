r"""Which noise a contact's profile stands for: its softness read as smoothing.

A ramp of slope $s$ averaged over noise on the distance is $F(r) = s\, \mathbb{E} \max(-r - w, 0)$, so that

$$\rho(w) = F''(-w) / s, \qquad \mathbb{E} w = \lim_{r \to -\infty} (-r - F(r) / s).$$

Read backwards: a profile of force against distance is that of noise exactly if it is convex, vanishes far away and runs along a
line of slope $-s$ deep inside. It is noise of no width (a point mass) if it is a ramp itself, which a margin shifts. MuJoCo's
impedance is no noise: where it rises with depth, the force is for a while steeper than in the end, and the density negative.
Nor is a force that jumps at the surface, as MuJoCo's does where the bodies accelerate against each other.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.contact.parameters import contact_parameters
from mjxgrad.scene import Scene
from mjxgrad.solver import constraint
from mjxgrad.solver.constraint import RowLayout, Rows
from mjxgrad.solver.jacobian import DenseRows
from mjxgrad.stepping.rows import law, one_sided
from mjxgrad.stepping.smoothing import Smoothing, noisy

Profile = Callable[[Float[Array, " n"]], Float[Array, " n"]]
_ForceAt = Callable[[np.ndarray], np.ndarray]

_NUM_POINTS = 2001  # of the grid
# Negative mass, of the whole, from which on it is not rounding and not the grid.
_NEGATIVE = 1e-4
# A single cell of the grid that holds this share of the mass holds a point mass.
_POINT = 0.5
# Exponent of the tail up to which the second moment is infinite, with room for its being read at a finite distance.
_HEAVIEST = 2.05


@dataclass(frozen=True)
class EquivalentNoise:
    """The noise on the distance that a profile is the average over, or why there is none.

    Attributes:
        is_noise: whether there is such noise.
        reason: in a few words, what kind it is or why there is none.
        mean: of the noise (m): how much deeper the bodies seem, negative where contact begins early, as by a margin.
            NaN if there is none.
        stddev: of the noise (m); infinite for heavy tails, zero for a point mass, NaN if there is none.
        slope: stiffness deep inside, in force per metre.
        noise: where the density is given (m), evenly spaced.
        density: second derivative of the profile over its slope (1/m); of a point mass what the grid makes of it. Negative
            somewhere if the profile is not convex.
    """

    is_noise: bool
    reason: str
    mean: float
    stddev: float
    slope: float
    noise: Float[np.ndarray, " n"]
    density: Float[np.ndarray, " n"]


def probe(profile: Profile, *, reach: float) -> EquivalentNoise:
    """Read a profile of force against distance as a ramp under noise.

    Args:
        profile: from distances (m), of any number, to the forces there; see `contact_profile`.
        reach: how far to both sides of the surface to look (m); some 20 lengths, or several widths of the impedance.
            From there on inwards the profile must be a line.

    Returns:
        The noise. Moments are sums over 2001 points, so that a width below their spacing reads as zero.

    Raises:
        ValueError: if reach is not positive, or the profile is not finite.
    """
    if not reach > 0:
        raise ValueError(f"reach must be positive, got {reach}")

    def force_at(distance: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        # Of one shape whatever is asked for, so that a profile under `jax.jit` is compiled once.
        padded = np.pad(distance, (0, _NUM_POINTS - len(distance)), mode="edge")
        return np.asarray(profile(jnp.asarray(padded)), float)[: len(distance)]

    grid = np.linspace(-reach, reach, _NUM_POINTS)
    force = force_at(grid)
    if not np.isfinite(force).all():
        where = grid[~np.isfinite(force)][0]
        raise ValueError(f"profile must be finite, got {force[~np.isfinite(force)][0]} at the distance {where:g} m")
    # Deeper than the grid, so that tails as long as the barrier's do not pass for a smaller slope.
    ends = force_at(np.array([-1000.0 * reach, -2000.0 * reach]))
    slope = float(ends[1] - ends[0]) / (1000 * reach)
    if not slope > 0:
        return _none(
            f"deep inside the force does not grow with depth (by {slope:.3g} per metre)", slope, grid, 0 * grid
        )
    mass = (force[2:] - 2 * force[1:-1] + force[:-2]) / ((grid[1] - grid[0]) * slope)
    # In order of the noise, which counts against the distance.
    w, mass = -grid[1:-1][::-1], mass[::-1]
    if reason := _objection(force_at, grid, force, mass, slope):
        return _none(reason, slope, w, mass / (grid[1] - grid[0]))
    mean = float(1000 * reach - ends[0] / slope)
    # Of heavy tails a little is left even a thousand times as deep as the grid.
    mean = 0.0 if abs(mean) < 1e-6 * reach else mean
    stddev = np.inf if _tail_exponent(force_at, reach, slope) < _HEAVIEST else _stddev(w, mass)
    reason = "noise with a density" + (" of infinite variance" if np.isinf(stddev) else "")
    if mass.max() > _POINT:
        reason, stddev = "a ramp: noise of no width", 0.0
    return EquivalentNoise(True, reason, mean, stddev, slope, w, mass / (grid[1] - grid[0]))


def contact_profile(scene: Scene, *, smoothing: Smoothing | None = None, acceleration: float = 0.0) -> Profile:
    """Give the force of the scene's first contact pair against distance, at rest and at a given acceleration.

    The distance is that between the geoms, so that a margin shifts the profile, and the force that of a frictionless row: as the
    solver would have it if the bodies had this acceleration.

    Args:
        scene: with the contact's parameters.
        smoothing: the noise over which it is averaged, if any.
        acceleration: of the distance (m/s²).

    Returns:
        From distances (m) to forces per unit of the contact's effective mass (N/kg).

    Raises:
        ValueError: if the scene has no pair.
    """
    if not scene.pairs:
        raise ValueError("scene must have a pair of geoms that can touch, got none")

    @jax.jit
    def profile(distance: Float[Array, " n"]) -> Float[Array, " n"]:
        parameters = contact_parameters(scene.model, scene.pairs[:1])
        ones = jnp.ones_like(distance)
        of_pair = (parameters.margin, parameters.solref, parameters.solimp)
        block = one_sided(DenseRows(ones[:, None]), distance, ones, np.zeros(len(distance), int), *of_pair)
        block = dataclasses.replace(block, is_contact=True)
        layout, row_noise = RowLayout(0, 0, len(distance)), None
        if smoothing is not None:
            block, row_noise = noisy(scene.model, block, jnp.ones(len(distance), bool), smoothing)
            layout = dataclasses.replace(layout, kernel=smoothing.noise)
        reference, weight = law(scene.model, jnp.zeros(1, distance.dtype), block)
        rows = Rows(reference, weight, block.friction_loss, (), row_noise)
        return constraint.force(layout, rows, jnp.where(block.is_active, acceleration, 0.0) - reference)

    return profile


def _objection(force_at: _ForceAt, grid: np.ndarray, force: np.ndarray, mass: np.ndarray, slope: float) -> str:
    """Say why a profile is not the mean of a ramp; nothing if it is."""
    spacing = grid[1] - grid[0]
    drops = -np.diff(force) / (slope * spacing)  # between 0 and 1 for a mean of ramps
    worst = int(np.argmax(np.abs(drops - 0.5)))
    between = np.linspace(grid[worst], grid[worst + 1], 65)
    fine = np.diff(force_at(between)) / (slope * spacing)
    if np.abs(fine).max() > 0.5 * abs(drops[worst]) and np.abs(fine).max() > _NEGATIVE:
        jump = -fine[np.argmax(np.abs(fine))] * slope * spacing
        return f"the force jumps by {jump:.3g} near the distance {grid[worst]:.3g} m"
    if mass.min() < -_NEGATIVE / 10 and -np.minimum(mass, 0).sum() > _NEGATIVE:
        where = grid[1:-1][::-1][np.argmin(mass)]
        return (
            f"not convex: the density is negative, most so at the distance {where:.3g} m, and sums to "
            f"{np.minimum(mass, 0).sum():.2g} there; the force is up to {drops.max():.3g} times as steep as deep inside"
        )
    if force[-1] > 0.01 * slope * grid[-1]:
        return f"the force does not vanish at a distance: it is {force[-1]:.3g} at {grid[-1]:.3g} m"
    return ""


def _tail_exponent(force_at: _ForceAt, reach: float, slope: float) -> float:
    """Give the exponent of the power by which the probability of large noise falls off, infinite if it falls off faster."""
    width = 1e-3 * reach

    def outside(size: float) -> float:
        ends = np.array([-size - width, -size + width, size - width, size + width])
        force = force_at(ends)
        return 1 - (force[0] - force[1] - force[2] + force[3]) / (2 * width * slope)

    near, far = outside(reach / 2), outside(reach)
    return float(np.log2(near / far)) if far > 1e-6 and near > 0 else np.inf


def _stddev(w: np.ndarray, mass: np.ndarray) -> float:
    total = mass.sum()
    mean = (w * mass).sum() / total
    return float(np.sqrt(max(((w - mean) ** 2 * mass).sum() / total, 0.0)))


def _none(reason: str, slope: float, w: np.ndarray, density: np.ndarray) -> EquivalentNoise:
    return EquivalentNoise(False, reason, np.nan, np.nan, slope, w, density)
