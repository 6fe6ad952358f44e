"""The tasks of Suh et al. in the paper's own equations.

Small dynamics in plain JAX, to reproduce published numbers; nothing here is MuJoCo's. Costs are without unit, other
quantities in SI units. Six were published: the push in two versions. Each function's defaults are the published settings.

References:
    Suh, Simchowitz, Zhang, Tedrake. Do Differentiable Simulators Give Better Policy Gradients? ICML 2022,
    arXiv:2202.00817, section 5 and its published settings.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from mjxgrad.objective.task import Outcome, PolicyFunction, Task


class QuadraticCost(eqx.Module):
    """Squares of what is left to the goal, and of the controls."""

    goal: Float[Array, " states"]  # g
    weight: Float[Array, " states"]  # diagonal of Q, charged before every step
    final_weight: Float[Array, " states"]  # diagonal of Q_d, charged after the last
    control_weight: Float[Array, ""]  # R, of the squared norm of the controls

    def stage(self, state: Float[Array, " states"], control: Float[Array, " nu"]) -> Float[Array, ""]:
        """Return (x − g)ᵀQ(x − g) + R‖u‖²."""
        return self.weight @ (state - self.goal) ** 2 + self.control_weight * (control**2).sum()

    def terminal(self, state: Float[Array, " states"]) -> Float[Array, ""]:
        """Return (x − g)ᵀQ_d(x − g)."""
        return self.final_weight @ (state - self.goal) ** 2


class DynamicsTask(Task):
    """A task whose state is a vector; a subclass gives `advance` and the nominal start."""

    cost: QuadraticCost
    horizon: int = eqx.field(static=True)

    @abstractmethod
    def advance(self, state: Float[Array, " states"], control: Float[Array, " nu"]) -> Float[Array, " states"]:
        """Return the next state."""

    def run(
        self,
        controls: Float[Array, "horizon nu"] | PolicyFunction,
        params: PyTree = None,
        noise: Float[Array, "horizon nu"] | None = None,
        start: Float[Array, " states"] | None = None,
    ) -> Outcome:
        start = self.nominal_start() if start is None else start
        shape = (self.horizon, self.num_controls)
        rows = jnp.zeros(shape) if callable(controls) else controls
        disturbances = jnp.zeros(shape) if noise is None else noise

        def step(state: Array, inputs: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            row, disturbance = inputs
            control = (controls(params, state) if callable(controls) else row) + disturbance
            return self.advance(state, control), (state, self.cost.stage(state, control))

        final, (states, charged) = jax.lax.scan(step, start, (rows, disturbances))
        step_costs = jnp.append(charged, self.cost.terminal(final))
        return Outcome(step_costs.sum(), states, step_costs)


MASS, TIMESTEP = 0.1, 0.005  # kg, s: of the push and the friction
REACH = 1.0  # m, of the spring
OVERLAP = 0.1  # m: farther apart the bodies of the friction do not touch
SLOPE, LIMIT = 1.8, 0.18  # N s/m, N


class Push(DynamicsTask):
    r"""The state is two positions (m) and two velocities (m/s), the control a force (N) on the first body.

    With $d = x_2 - x_1$ the spring of stiffness $k$ (N/m) pushes with $F = k(1 - d)$ where $d < 1$. Velocities are
    stepped first, of which a factor is left after each step, and positions with the new ones.
    """

    stiffness: Float[Array, ""]
    velocity_factor: Float[Array, ""]
    num_controls: int = eqx.field(static=True, default=1)

    def nominal_start(self) -> Float[Array, " 4"]:
        """Return both bodies at rest, just touching."""
        return jnp.array([0.0, REACH, 0.0, 0.0])

    def advance(self, state: Float[Array, " 4"], control: Float[Array, " 1"]) -> Float[Array, " 4"]:
        positions, velocities = state[:2], state[2:]
        force = self.stiffness * jnp.maximum(REACH - (positions[1] - positions[0]), 0.0)
        accelerations = jnp.stack([control[0] - force, force]) / MASS
        velocities = self.velocity_factor * velocities + TIMESTEP * accelerations
        return jnp.concatenate([positions + TIMESTEP * velocities, velocities])


def push(stiffness: float = 10.0, velocity_factor: float = 0.998, horizon: int = 400) -> Push:
    """Make the task; see `Push`. The stiff one of the paper has 1000 N/m, a factor of 0.99 and 200 steps."""
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = QuadraticCost(jnp.array([1.0, 2.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return Push(
        stiffness=jnp.asarray(stiffness, float),
        velocity_factor=jnp.asarray(velocity_factor, float),
        cost=cost,
        horizon=horizon,
    )


class Friction(DynamicsTask):
    r"""The state is two positions (m) and two velocities (m/s), the control a force (N) on the first body.

    Friction on the second is $\mathrm{clip}(1.8(v_1 - v_2), \pm 0.18)$ within 0.1 m of the first, and none beyond: the
    cost jumps where the first slips from under it.
    """

    num_controls: int = eqx.field(static=True, default=1)

    def nominal_start(self) -> Float[Array, " 4"]:
        """Return both bodies at rest, one on the other."""
        return jnp.zeros(4)

    def advance(self, state: Float[Array, " 4"], control: Float[Array, " 1"]) -> Float[Array, " 4"]:
        positions, velocities = state[:2], state[2:]
        is_touching = jnp.abs(positions[1] - positions[0]) < OVERLAP
        drag = jnp.where(is_touching, jnp.clip(SLOPE * (velocities[0] - velocities[1]), -LIMIT, LIMIT), 0.0)
        velocities = velocities + TIMESTEP / MASS * jnp.stack([control[0] - drag, drag])
        return jnp.concatenate([positions + TIMESTEP * velocities, velocities])


def friction() -> Friction:
    """Make the task; see `Friction`."""
    weight = jnp.array([0.1, 10.0, 0.1, 0.1])
    cost = QuadraticCost(jnp.array([2.0, 2.0, 0.0, 0.0]), weight, weight, jnp.array(1.0))
    return Friction(cost=cost, horizon=400)


_START_STDDEV = 0.001


class LQR(DynamicsTask):
    """The state is a vector x, the control a vector u of the same size, and x' = x + u."""

    num_controls: int = eqx.field(static=True)

    def nominal_start(self) -> Float[Array, " states"]:
        return jnp.ones(self.num_controls)

    def sample_start(self, key: PRNGKeyArray) -> Float[Array, " states"]:
        """Draw a state beside it."""
        return self.nominal_start() + _START_STDDEV * jax.random.normal(key, (self.num_controls,))

    def advance(self, state: Float[Array, " states"], control: Float[Array, " states"]) -> Float[Array, " states"]:
        return state + control


def lqr(num_states: int = 100) -> LQR:
    """Make the task; see `LQR`."""
    ones = jnp.ones(num_states)
    cost = QuadraticCost(0 * ones, ones, 10 * ones, jnp.array(0.1))
    return LQR(cost=cost, num_controls=num_states, horizon=10)


_POINT_TIMESTEP = 0.01  # s
CENTRES = ((-0.2, 0.5), (0.5, 1.2), (0.0, 2.3), (0.4, 3.2), (-0.8, 3.8), (-1.0, 1.0), (0.0, 1.5))  # m
RADII = (0.2, 0.2, 0.3, 0.5, 0.1, 0.5, 0.2)  # m


class MotionPlanning(DynamicsTask):
    """The state is a position (m), the control a velocity (m/s); a step that would end in a disc is not taken."""

    num_controls: int = eqx.field(static=True, default=2)

    def nominal_start(self) -> Float[Array, " 2"]:
        return jnp.zeros(2)

    def advance(self, state: Float[Array, " 2"], control: Float[Array, " 2"]) -> Float[Array, " 2"]:
        moved = state + _POINT_TIMESTEP * control
        squared_distances = ((moved - jnp.array(CENTRES)) ** 2).sum(axis=1)
        is_blocked = (squared_distances < jnp.array(RADII) ** 2).any()
        return jnp.where(is_blocked, state, moved)


def motion_planning() -> MotionPlanning:
    """Make the task; see `MotionPlanning`."""
    cost = QuadraticCost(jnp.array([0.0, 4.0]), jnp.ones(2), 10 * jnp.ones(2), jnp.array(0.001))
    return MotionPlanning(cost=cost, horizon=200)


_PAD_TIMESTEP = 0.05  # s
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
    """

    num_controls: int = eqx.field(static=True, default=3)

    def nominal_start(self) -> Float[Array, " 7"]:
        """Return the mean of the starts: the ball 2 m above a level pad and on its way to it."""
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
        position, velocity, pad = state[:2], state[2:4], state[4:]
        moved, moved_pad = position + _PAD_TIMESTEP * velocity, pad + _PAD_TIMESTEP * control
        cosine, sine = jnp.cos(moved_pad[2]), jnp.sin(moved_pad[2])
        along, across = jnp.stack([cosine, sine]), jnp.stack([-sine, cosine])
        x, y = along @ (moved - pad[:2]), across @ (moved - pad[:2])
        is_hit = (jnp.abs(x) <= HALF_LENGTH + RADIUS) & (jnp.abs(y) <= HALF_WIDTH + RADIUS)
        speed = across @ velocity
        bounced = velocity - 2 * speed * across
        # A ball at rest against the pad has no time to impact; the derivative of the branch not taken must be finite, too.
        is_moving = is_hit & (speed != 0)
        time = _PAD_TIMESTEP + jnp.where(is_moving, (HALF_WIDTH + RADIUS - y) / jnp.where(is_moving, speed, 1.0), 0.0)
        turned = position + time * velocity + (_PAD_TIMESTEP - time) * bounced
        free = VELOCITY_FACTOR * velocity
        return jnp.concatenate(
            [
                jnp.where(is_hit, turned, moved),
                jnp.where(is_hit, bounced, free),
                jnp.where(is_hit, pad, moved_pad),
            ]
        )


def tennis() -> Tennis:
    """Make the task; see `Tennis`."""
    goal = jnp.array([0.0, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    final_weight = jnp.array([100.0, 100.0, 10.0, 10.0, 0.0, 0.0, 0.0])
    return Tennis(cost=QuadraticCost(goal, jnp.zeros(7), final_weight, jnp.array(0.001)), horizon=200)
