r"""A ball in the plane, to be returned by a pad that a linear policy moves and turns.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 and its published settings.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mjxgrad.tasks.published.dynamics import DynamicsTask, QuadraticCost

TIMESTEP = 0.05  # s
HALF_LENGTH, HALF_WIDTH, RADIUS = 0.8, 0.05, 0.15  # m: of the pad, of the ball
VELOCITY_FACTOR = 0.999


class Tennis(DynamicsTask):
    r"""The state is the ball's position and velocity, then the pad's position and angle (m, m/s, rad).

    The control is the pad's velocity and rate of turning. The collision is looked for after the step, in a frame with
    the pad's new angle and its old position, where $(X, Y)$ is the ball and $(V_x, V_y)$ its velocity. If the ball is
    within the pad grown by the ball's radius, $V_y$ flips, the pad keeps its old pose, and the ball follows its old
    velocity for the time to impact $\tau = h(1 - (0.2 - Y)/(Y_0 - Y))$, $Y_0 = Y - hV_y$, and the new one for the rest.
    Without a collision the whole velocity shrinks by the factor 0.999. That reading gives a start cost of 218 ± 1 (206
    published, over 1000 starts: ± 12); shrinking $V_y$ alone gives 263.

    Attributes:
        cost: quadratic.
        horizon: number of steps.
    """

    cost: QuadraticCost
    horizon: int = eqx.field(static=True)
    num_controls: int = eqx.field(static=True, default=3)

    def nominal_start(self) -> Float[Array, " 7"]:
        """Give the mean of the starts: the ball 2 m above a level pad and on its way to it."""
        return jnp.array([0.0, 2.0, 0.0, -0.4, 0.0, 0.0, 0.0])

    def sample_start(self, key: PRNGKeyArray) -> Float[Array, " 7"]:
        """Draw a ball on its way to the origin, and a pad near it."""
        x_key, y_key, velocity_key, pad_key = jax.random.split(key, 4)
        x = jax.random.uniform(x_key, minval=-2.0, maxval=2.0)
        position = jnp.stack([x, 2.0 + 0.2 * jax.random.normal(y_key)])
        velocity = -0.2 * position + 0.03 * jax.random.normal(velocity_key, (2,))
        pad = jnp.array([0.5, 0.05, 0.05]) * jax.random.normal(pad_key, (3,))
        return jnp.concatenate([position, velocity, pad])

    def advance(self, state: Float[Array, " 7"], control: Float[Array, " 3"]) -> Float[Array, " 7"]:
        """Give the next state."""
        position, velocity, pad = state[:2], state[2:4], state[4:]
        moved, moved_pad = position + TIMESTEP * velocity, pad + TIMESTEP * control
        cosine, sine = jnp.cos(moved_pad[2]), jnp.sin(moved_pad[2])
        along, across = jnp.stack([cosine, sine]), jnp.stack([-sine, cosine])
        x, y = along @ (moved - pad[:2]), across @ (moved - pad[:2])
        is_hit = (jnp.abs(x) <= HALF_LENGTH + RADIUS) & (jnp.abs(y) <= HALF_WIDTH + RADIUS)
        speed = across @ velocity
        bounced = velocity - 2 * speed * across
        # A ball at rest against the pad has no time to impact; the derivative of the branch not taken must be finite, too.
        is_moving = is_hit & (speed != 0)
        time = TIMESTEP + jnp.where(is_moving, (HALF_WIDTH + RADIUS - y) / jnp.where(is_moving, speed, 1.0), 0.0)
        turned = position + time * velocity + (TIMESTEP - time) * bounced
        free = VELOCITY_FACTOR * velocity
        return jnp.concatenate(
            [
                jnp.where(is_hit, turned, moved),
                jnp.where(is_hit, bounced, free),
                jnp.where(is_hit, pad, moved_pad),
            ]
        )


def tennis_task() -> Tennis:
    """Make the task; see `Tennis`."""
    goal = jnp.array([0.0, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    final_weight = jnp.array([100.0, 100.0, 10.0, 10.0, 0.0, 0.0, 0.0])
    return Tennis(cost=QuadraticCost(goal, jnp.zeros(7), final_weight, jnp.array(0.001)), horizon=200)
