r"""Costs of one number whose smoothed gradient, and the errors of its estimates, are known.

With $w \sim N(0, \sigma^2)$ the smoothed cost is $F(\theta) = \mathbb{E} f(\theta + w)$. Each problem says what an
estimate of $F'$ should give and how far one sample of it is off: the yardstick for estimators, for diagnostics and for
whoever wants to see in a second what a contact does to a gradient. Points, widths and costs have no units.

All methods are for one point and are traceable: a sweep of points, noise or widths is a `jax.vmap`.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 3 and figure 2.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mjxgrad._arrays import known
from mjxgrad.objective import ParameterNoise, parameter_noise
from mjxgrad.scene import Scene, load_scene

# Beyond nine standard deviations a Gaussian is below 1e-17. Pieces of at most one standard deviation with 16 nodes are
# exact to rounding for all costs here (a sine of two periods per standard deviation included).
_EDGES = np.arange(-9.0, 10.0)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


class Textbook(eqx.Module):
    """A cost of one number with what theory says about its gradient under Gaussian noise."""

    @abstractmethod
    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Return the cost."""

    @property
    @abstractmethod
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        """Where the cost has a kink or a jump."""

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the smoothed cost, F(θ), by quadrature where there is no closed form."""
        return self._mean(lambda x, _: jax.vmap(self)(x[:, None]), point, stddev)

    @abstractmethod
    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return what is to be estimated, F'(θ)."""

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return what the first-order estimate converges to, E f'(θ + w): the gradient, but for jumps of the cost."""
        return self.gradient(point, stddev)

    @abstractmethod
    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the variance of one sample of the first-order estimate, Var f'(θ + w)."""

    def mean_square(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        """Return E (f(θ + w) − b)², by quadrature where there is no closed form."""
        return self._mean(lambda x, _: (jax.vmap(self)(x[:, None]) - baseline) ** 2, point, stddev)

    def zeroth_order_variance(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        r"""Return the variance of one sample of the zeroth-order estimate, $(f(\theta + w) - b)\,w/\sigma^2$.

        It is $\mathbb{E}[(f - b)^2 w^2]/\sigma^4 - F'^2$, by quadrature where there is no closed form. The baseline $b$
        does not depend on the sample: 0, the cost without noise, or any other number.
        """
        second = self._mean(lambda x, z: ((jax.vmap(self)(x[:, None]) - baseline) * z / stddev) ** 2, point, stddev)
        return second - self.gradient(point, stddev) ** 2

    def leave_one_out_variance(self, point: ArrayLike, stddev: ArrayLike, num_samples: int) -> Float[Array, ""]:
        r"""Return the variance of the whole zeroth-order estimate with its leave-one-out baseline.

        The estimate is the sample covariance of cost and score, whose variance is
        $\mathrm{Var}[(f - F)s]/N + (\mathrm{Var} f\,\mathrm{Var} s + F'^2)/(N(N - 1))$ for every number of samples
        $N \ge 2$. Times $N$ it tends to `zeroth_order_variance` with baseline $F$.
        """
        mean = self.smoothed(point, stddev)
        single = self.zeroth_order_variance(point, stddev, mean)
        both = self.mean_square(point, stddev, mean) / jnp.square(stddev) + self.gradient(point, stddev) ** 2
        return single / num_samples + both / (num_samples * (num_samples - 1))

    def objective(self, stddev: float | Float[Array, ""]) -> ParameterNoise:
        """Return the cost as estimators see it, with noise on its one parameter."""
        return parameter_noise(self, stddev, dim=1)

    def _mean(self, function: Callable[[Array, Array], Array], point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return E function(θ + σz, z), the line cut where the cost has a kink or a jump."""
        inner = jnp.clip((self.breakpoints - point) / stddev, _EDGES[0], _EDGES[-1])
        edges = jnp.sort(jnp.concatenate([jnp.asarray(_EDGES, inner.dtype), inner]))
        half = jnp.diff(edges)[:, None] / 2
        z = (edges[:-1, None] + half) + half * _NODES
        weights = half * _WEIGHTS * norm.pdf(z)
        return (weights.ravel() * function(jnp.asarray(point) + stddev * z.ravel(), z.ravel())).sum()


def number(value: ArrayLike) -> Float[Array, ""]:
    """Return a number as an array of floating point."""
    return jnp.asarray(value, jnp.result_type(value, float))


def positive(value: ArrayLike, name: str) -> Float[Array, ""]:
    """Return a number as an array of floating point, refusing one that is not positive."""
    array = number(value)
    values = known(array)  # None in a sweep
    if values is not None and not (values > 0).all():
        raise ValueError(f"{name} must be positive, got {value}")
    return array


# Intervals shorter than this, in standard deviations, have their probability by series: a difference would cancel.
_SHORT = 0.02


class Heaviside(Textbook):
    """See `heaviside`."""

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        return jnp.where(x[0] >= 0, jnp.ones_like(x[0]), 0)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.zeros(1)

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return norm.cdf(point, scale=stddev)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return norm.pdf(point, scale=stddev)

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return jnp.zeros_like(norm.pdf(point, scale=stddev))

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return jnp.zeros_like(norm.pdf(point, scale=stddev))


class SoftHeaviside(Textbook):
    """See `soft_heaviside`."""

    width: Float[Array, ""]

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        return jnp.clip(2 * x[0] / self.width, -1, 1)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.stack([-self.width, self.width]) / 2

    def slope_probability(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the chance p that a sample falls on the slope, the only place where the derivative is not zero."""
        return _probability(-jnp.asarray(point) / stddev, self.width / stddev)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return 2 * self.slope_probability(point, stddev) / self.width

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        p = self.slope_probability(point, stddev)
        return (2 / self.width) ** 2 * p * (1 - p)


def heaviside() -> Heaviside:
    r"""Return the step, 1 from zero on: $F' = \varphi(\theta/\sigma)/\sigma$, and no derivative that sees it."""
    return Heaviside()


def soft_heaviside(width: ArrayLike) -> SoftHeaviside:
    r"""Return the ramp from −1 to 1 about zero, a step that has been softened.

    With $p$ the chance to fall on the slope, $F' = 2p/\nu$, and a first-order sample is $2/\nu$ with probability $p$,
    else 0: unbiased, with variance $(2/\nu)^2 p(1 - p)$, which grows as $1/\nu$.

    Args:
        width: $\nu > 0$ of the slope; $1/\nu$ is the stiffness.

    Raises:
        ValueError: if `width` is not positive.
    """
    return SoftHeaviside(positive(width, "width"))


def _probability(middle: Float[Array, ""], length: Float[Array, ""]) -> Float[Array, ""]:
    """Return the chance of a standard normal variable to lie in an interval, to many digits."""
    series = length * norm.pdf(middle) * (1 + (middle**2 - 1) * length**2 / 24)
    # In the upper tail both distribution functions are near 1: mirrored they are small numbers.
    low = -jnp.abs(middle)
    difference = norm.cdf(low + length / 2) - norm.cdf(low - length / 2)
    return jnp.where(length < _SHORT, series, difference)


class QuadraticSine(Textbook):
    """See `quadratic_sine`."""

    amplitude: Float[Array, ""]
    frequency: Float[Array, ""]

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        return x[0] ** 2 + self.amplitude * jnp.sin(self.frequency * x[0])

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return jnp.zeros(0)

    def damping(self, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the share exp(−ω²σ²/2) of the ripple that the noise leaves."""
        return jnp.exp(-((self.frequency * stddev) ** 2) / 2)

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        ripple = self.amplitude * self.damping(stddev) * jnp.sin(self.frequency * point)
        return jnp.square(point) + jnp.square(stddev) + ripple

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        slope = self.amplitude * self.frequency * self.damping(stddev)
        return 2 * jnp.asarray(point) + slope * jnp.cos(self.frequency * point)

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        slope, left, angle = self.amplitude * self.frequency, self.damping(stddev), self.frequency * point
        cosine = (1 + left**4 * jnp.cos(2 * angle)) / 2 - (left * jnp.cos(angle)) ** 2
        # Stein: Cov(x, cos ωx) = σ² E[−ω sin ωx].
        together = -jnp.square(stddev) * self.frequency * left * jnp.sin(angle)
        return 4 * jnp.square(stddev) + slope**2 * cosine + 4 * slope * together

    def mean_square(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        x, v, left, angle = jnp.asarray(point), jnp.square(stddev), self.damping(stddev), self.frequency * point
        square, fourth = x**2 + v, x**4 + 6 * x**2 * v + 3 * v**2
        sine_square = (1 - left**4 * jnp.cos(2 * angle)) / 2
        # E x² sin ωx = −d²/dω² E sin ωx.
        shifted = (square - (self.frequency * v) ** 2 - baseline) * jnp.sin(angle)
        mixed = left * (shifted + 2 * x * self.frequency * v * jnp.cos(angle))
        parabola = fourth - 2 * jnp.asarray(baseline) * square + jnp.square(baseline)
        return parabola + self.amplitude**2 * sine_square + 2 * self.amplitude * mixed

    def zeroth_order_variance(self, point: ArrayLike, stddev: ArrayLike, baseline: ArrayLike = 0.0) -> Float[Array, ""]:
        point = jnp.asarray(point, jnp.result_type(point, float))
        # Stein twice: E g z² = G + σ² G'' with G = E g.
        curvature = jax.grad(jax.grad(self.mean_square))(point, stddev, baseline)
        second = self.mean_square(point, stddev, baseline) / jnp.square(stddev) + curvature
        return second - self.gradient(point, stddev) ** 2


def quadratic_sine(amplitude: ArrayLike, frequency: ArrayLike) -> QuadraticSine:
    r"""Return $x^2 + m \sin\omega x$: smooth, with a ripple whose slope $m\omega$ may be of any size.

    $F' = 2\theta + m\omega e^{-\omega^2\sigma^2/2}\cos\omega\theta$: the noise wipes the ripple out, while the
    variance of first order keeps $m^2\omega^2/2$.

    Args:
        amplitude: $m$.
        frequency: $\omega$, in rad per unit of the parameter.
    """
    return QuadraticSine(number(amplitude), number(frequency))


# The range is periodic in the angle; the noise may reach this many periods to either side.
_PERIODS = np.pi * np.arange(-2, 3)


class BallOverWall(Textbook):
    """See `ball_over_wall`; methods hold where nine standard deviations stay within 2π of the horizontal."""

    speed: Float[Array, ""]
    gravity: Float[Array, ""]
    distance: Float[Array, ""]
    height: Float[Array, ""]

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Return minus the squared range, in m²; a throw that the wall stops ends at the wall."""
        reach = self._range(x[0])
        fall = self.gravity * (self.distance / (self.speed * jnp.cos(x[0]))) ** 2 / 2
        is_blocked = (reach > self.distance) & (self.distance * jnp.tan(x[0]) - fall < self.height)
        return -jnp.square(jnp.where(is_blocked, self.distance, reach))

    @property
    def kinks(self) -> Float[Array, " 2"]:
        """Return the angles, in rad, whose throws end at the foot of the wall."""
        first = jnp.arcsin(self.distance * self.gravity / self.speed**2) / 2
        return jnp.stack([first, jnp.pi / 2 - first])

    @property
    def jumps(self) -> Float[Array, " 2"]:
        """Return the angles, in rad, whose throws graze the top of the wall."""
        # At the wall the height is d tan θ − c(1 + tan² θ): a quadratic in the tangent.
        c = self.gravity * self.distance**2 / (2 * self.speed**2)
        root = jnp.sqrt(self.distance**2 - 4 * c * (c + self.height))
        return jnp.arctan(jnp.stack([self.distance - root, self.distance + root]) / (2 * c))

    @property
    def jump_sizes(self) -> Float[Array, " 2"]:
        """Return the change of cost at each of `jumps`, from left to right, in m²."""
        return jnp.array([1.0, -1.0]) * (self.distance**2 - self._range(self.jumps) ** 2)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return (jnp.concatenate([self.kinks, self.jumps]) + _PERIODS[:, None]).ravel()

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Return the mean derivative and, for each jump, its size times the density of the noise there."""
        places = (self.jumps + _PERIODS[:, None]).ravel()
        seen = jnp.tile(self.jump_sizes, len(_PERIODS)) * norm.pdf(places, point, stddev)
        return self.first_order_mean(point, stddev) + seen.sum()

    def first_order_mean(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return self._mean(lambda x, _: self._slopes(x), point, stddev)

    def first_order_variance(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        mean = self.first_order_mean(point, stddev)
        return self._mean(lambda x, _: (self._slopes(x) - mean) ** 2, point, stddev)

    def _range(self, angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return self.speed**2 * jnp.sin(2 * angle) / self.gravity

    def _slopes(self, x: Float[Array, " nodes"]) -> Float[Array, " nodes"]:
        return jax.vmap(jax.grad(self))(x[:, None])[:, 0]


def ball_over_wall(
    speed: ArrayLike = 1.0, gravity: ArrayLike = 9.81, distance: ArrayLike = 0.06, height: ArrayLike = 0.02
) -> BallOverWall:
    r"""Return minus the squared range of a throw, as a function of its angle in rad, with a wall in the way.

    A throw that meets the wall falls down at its foot. The cost has two kinks (throws that just reach the wall) and two
    jumps (throws that graze its top), so $F' = \mathbb{E} f' + \sum_j J_j \varphi((t_j - \theta)/\sigma)/\sigma$, of
    which first order sees the mean alone: with noise of 0.1 rad at 0.8 rad it has the wrong sign. Moments are taken by
    quadrature between the kinks and jumps, exact to rounding.

    Args:
        speed: of the throw, in m/s.
        gravity: in m/s².
        distance: of the wall, in m.
        height: of the wall, in m.

    Raises:
        ValueError: if a number is not positive, or no throw clears the wall.
    """
    speed, gravity = positive(speed, "speed"), positive(gravity, "gravity")
    distance, height = positive(distance, "distance"), positive(height, "height")
    # The parabola of safety: v²/(2g) − g d²/(2v²) is the greatest height at the distance d.
    highest = speed**2 / (2 * gravity) - gravity * distance**2 / (2 * speed**2)
    if not isinstance(highest, jax.core.Tracer) and not bool((height < highest).all()):
        raise ValueError(f"height must be below {highest}, the highest that a throw passes the wall at, got {height}")
    return BallOverWall(speed, gravity, distance, height)


# Reference accelerations are taken as written: `refsafe` would replace a time constant below two time steps.
_SCENE = """
<mujoco model="bounce">
  <option gravity="0 0 0" timestep="{timestep}"><flag refsafe="disable"/></option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="ball" pos="0 0 0.05">
      <joint name="height" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.05"/>
    </body>
  </worldbody>
</mujoco>
"""


def bounce_scene(timestep: float = 1e-3) -> Scene:
    """Load the ball over the floor, without gravity and `refsafe`; the time step is in s.

    Its position is its height above the floor, in m. Contact is MuJoCo's default.
    """
    return load_scene(_SCENE.format(timestep=timestep))
