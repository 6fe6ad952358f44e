"""Functions whose smoothed gradient is known in closed form (none of them symmetric at the points used)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy.stats import norm

from mjxgrad import estimators
from mjxgrad.estimators import GradientEstimate
from mjxgrad.objective.task import Outcome
from mjxgrad.tasks import Task

STDDEV = 0.1
# Of `bumpy`, and of the linear system.
POINT, STDDEVS = jnp.array([0.3, 0.1, -0.5]), jnp.array([0.1, 0.2, 0.3])
POLICY_PARAMS = {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.25])}
CONTROLS = jnp.array([[0.4], [-0.7], [0.2], [0.9]])

# Compiled as a whole: one compilation each in place of some thirty small ones.
first_order = eqx.filter_jit(estimators.first_order)
zeroth_order = eqx.filter_jit(estimators.zeroth_order)
first_and_zeroth_order = eqx.filter_jit(estimators.first_and_zeroth_order)


def step(x: Float[Array, " 1"]) -> Float[Array, ""]:
    """1 from zero on, else 0."""
    return jnp.where(x[0] >= 0, 1.0, 0.0)


def step_gradient(point: float) -> float:
    """The density of the noise at the jump."""
    return norm.pdf(point / STDDEV) / STDDEV


def ramp(width: float):
    """From -1 to 1 over a width about zero."""
    return lambda x: jnp.clip(2 * x[0] / width, -1, 1)


def ramp_probability(point: float, width: float) -> float:
    """The chance to be on the slope."""
    return norm.cdf((width / 2 - point) / STDDEV) - norm.cdf((-width / 2 - point) / STDDEV)


def quadratic_sine(x: Float[Array, " 1"]) -> Float[Array, ""]:
    """x² + 0.1 sin(20 x)."""
    return x[0] ** 2 + 0.1 * jnp.sin(20 * x[0])


def quadratic_sine_gradient(point: float) -> float:
    """E x² = θ² + σ²; E sin(ωx) = exp(-ω²σ²/2) sin(ωθ)."""
    return 2 * point + 0.1 * 20 * np.exp(-(20**2) * STDDEV**2 / 2) * np.cos(20 * point)


def bumpy(x: Float[Array, " 3"]) -> Float[Array, ""]:
    """Three coordinates that have nothing in common."""
    return x[0] ** 2 * x[1] + jnp.exp(x[2]) + x[2]


def bumpy_gradient(x: np.ndarray, stddev: np.ndarray) -> np.ndarray:
    """E (x₀+w₀)²(x₁+w₁) = (x₀²+σ₀²)x₁; E exp(x₂+w₂) = exp(x₂ + σ₂²/2)."""
    return np.array([2 * x[0] * x[1], x[0] ** 2 + stddev[0] ** 2, np.exp(x[2] + stddev[2] ** 2 / 2) + 1])


class LinearSystem(Task):
    """x' = A x + B u, cost Σ (|x|² + 0.3 |u|²) + 2|x_T - 1|²: everything is known about it."""

    horizon: int = eqx.field(static=True, default=4)
    num_controls: int = eqx.field(static=True, default=1)
    transition: Float[Array, "2 2"] = eqx.field(default_factory=lambda: jnp.array([[1.0, 0.3], [-0.2, 0.8]]))
    input_matrix: Float[Array, "2 1"] = eqx.field(default_factory=lambda: jnp.array([[0.5], [1.1]]))
    start: Float[Array, " 2"] = eqx.field(default_factory=lambda: jnp.array([0.7, -0.4]))

    def nominal_start(self):
        return self.start

    def run(self, controls, params: PyTree = None, noise=None, start=None) -> Outcome:
        is_policy = callable(controls)
        noise = jnp.zeros((self.horizon, self.num_controls)) if noise is None else noise

        def advance(state, step):
            control = (controls(params, state) if is_policy else controls[step]) + noise[step]
            cost = state @ state + 0.3 * control @ control
            return self.transition @ state + self.input_matrix @ control, (cost, state)

        start = self.start if start is None else start
        final, (costs, states) = jax.lax.scan(advance, start, jnp.arange(self.horizon))
        step_costs = jnp.append(costs, 2 * ((final - 1) ** 2).sum())
        return Outcome(step_costs.sum(), states, step_costs)

    def expected_cost(self, policy_params: dict, stddev: float) -> Float[Array, ""]:
        """Under u = K x + k + w: mean and covariance of a linear system follow by recursion."""
        gain, offset = policy_params["gain"], policy_params["offset"]
        mean, covariance, total = self.start, jnp.zeros((2, 2)), 0.0
        closed = self.transition + self.input_matrix @ gain
        for _ in range(self.horizon):
            control_mean = gain @ mean + offset
            control_covariance = gain @ covariance @ gain.T + stddev**2 * jnp.eye(1)
            total += mean @ mean + jnp.trace(covariance)
            total += 0.3 * (control_mean @ control_mean + jnp.trace(control_covariance))
            mean = closed @ mean + self.input_matrix @ offset
            covariance = closed @ covariance @ closed.T + stddev**2 * self.input_matrix @ self.input_matrix.T
        return total + 2 * (((mean - 1) ** 2).sum() + jnp.trace(covariance))


class RandomStart(LinearSystem):
    """The same system from a start that is drawn."""

    def sample_start(self, key):
        return self.start + 0.5 * jax.random.normal(key, (2,))


def linear_policy(params: dict, state: Float[Array, " 2"]) -> Float[Array, " 1"]:
    return params["gain"] @ state + params["offset"]


def assert_within_error(estimate: GradientEstimate, truth, num_errors: float = 4.0) -> None:
    """The estimate is within some of its own standard errors of the truth, and these are not NaN or silly."""
    error = np.abs(np.asarray(estimate.value) - truth)
    assert np.all(error <= num_errors * np.asarray(estimate.standard_error)), (estimate.value, truth)
    # An error bar as wide as the value proves nothing.
    assert np.all(np.asarray(estimate.standard_error) < 0.2 * np.abs(truth)), estimate.standard_error


def repeat(estimator, objective, params, times: int, seed: int, **settings) -> GradientEstimate:
    """Return as many estimates, each of its own noise."""
    keys = jax.random.split(jax.random.key(seed), times)
    return jax.jit(jax.vmap(lambda key: estimator(objective, params, key, **settings)))(keys)
