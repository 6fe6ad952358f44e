"""A point thrown over a wall, in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mjxgrad.tasks.textbook.problem import Textbook, positive

# The range is periodic in the angle; the noise may reach this many periods to either side.
_PERIODS = np.pi * np.arange(-2, 3)


class BallOverWall(Textbook):
    """See `ball_over_wall`; methods hold where nine standard deviations stay within 2π of the horizontal."""

    speed: Float[Array, ""]
    gravity: Float[Array, ""]
    distance: Float[Array, ""]
    height: Float[Array, ""]

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give minus the squared range, in m²; a throw that the wall stops ends at the wall."""
        reach = self._range(x[0])
        fall = self.gravity * (self.distance / (self.speed * jnp.cos(x[0]))) ** 2 / 2
        is_blocked = (reach > self.distance) & (self.distance * jnp.tan(x[0]) - fall < self.height)
        return -jnp.square(jnp.where(is_blocked, self.distance, reach))

    @property
    def kinks(self) -> Float[Array, " 2"]:
        """Give the angles, in rad, whose throws end at the foot of the wall."""
        first = jnp.arcsin(self.distance * self.gravity / self.speed**2) / 2
        return jnp.stack([first, jnp.pi / 2 - first])

    @property
    def jumps(self) -> Float[Array, " 2"]:
        """Give the angles, in rad, whose throws graze the top of the wall."""
        # At the wall the height is d tan θ − c(1 + tan² θ): a quadratic in the tangent.
        c = self.gravity * self.distance**2 / (2 * self.speed**2)
        root = jnp.sqrt(self.distance**2 - 4 * c * (c + self.height))
        return jnp.arctan(jnp.stack([self.distance - root, self.distance + root]) / (2 * c))

    @property
    def jump_sizes(self) -> Float[Array, " 2"]:
        """Give the change of cost at each of `jumps`, from left to right, in m²."""
        return jnp.array([1.0, -1.0]) * (self.distance**2 - self._range(self.jumps) ** 2)

    @property
    def breakpoints(self) -> Float[Array, " breakpoints"]:
        return (jnp.concatenate([self.kinks, self.jumps]) + _PERIODS[:, None]).ravel()

    def smoothed(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        return self._mean(lambda x, _: jax.vmap(self)(x[:, None]), point, stddev)

    def gradient(self, point: ArrayLike, stddev: ArrayLike) -> Float[Array, ""]:
        """Give the mean derivative and, for each jump, its size times the density of the noise there."""
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
    r"""Give minus the squared range of a throw, as a function of its angle in rad, with a wall in the way.

    A throw that meets the wall falls down at its foot. The cost has two kinks (throws that just reach the wall) and two
    jumps (throws that graze its top), so $F' = \mathbb{E} f' + \sum_j J_j \varphi((t_j - \theta)/\sigma)/\sigma$, of
    which first order sees the mean alone: with noise of 0.1 rad at 0.8 rad it has the wrong sign. Moments are taken by
    quadrature between the kinks and jumps, exact to rounding.

    Args:
        speed: of the throw, in m/s.
        gravity: in m/s².
        distance: of the wall, in m.
        height: of the wall, in m.

    Returns:
        The problem.

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
