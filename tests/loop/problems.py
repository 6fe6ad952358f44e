"""Costs whose minimum is known, and estimators whose every number is chosen."""

import functools

import jax.numpy as jnp

from mjxgrad import estimators
from mjxgrad.estimators import Diagnosis, GradientEstimate, Reason
from mjxgrad.objective import parameter_noise

CENTRE = jnp.array([1.0, -2.0])
CURVATURE = jnp.array([1.0, 3.0])
STDDEV = 0.1
START = jnp.array([0.0, 0.5])


def bowl(x):
    """Its gradient is CURVATURE (x - CENTRE); noise adds a constant, σ²/2 of the trace of the curvature."""
    return 0.5 * (CURVATURE * (x - CENTRE) ** 2).sum()


objective = parameter_noise(bowl, STDDEV, dim=2)
zeroth_order = functools.partial(estimators.zeroth_order, num_samples=16)
first_order = functools.partial(estimators.first_order, num_samples=4)


def made_up(value, *, error=0.0, cost=0.0, cost_error=0.0, bias_bound=0.0, num_rollouts=1, alpha=0.0):
    """An estimate that says just this."""
    value = jnp.asarray(value, float)
    number = lambda x: jnp.asarray(x, value.dtype)  # noqa: E731
    return GradientEstimate(
        value=value,
        standard_error=jnp.broadcast_to(number(error), value.shape),
        covariance_diagonal=jnp.zeros_like(value),
        objective_mean=number(cost),
        objective_standard_error=number(cost_error),
        num_samples=jnp.asarray(num_rollouts),
        num_finite=jnp.asarray(num_rollouts),
        num_rollouts=jnp.asarray(num_rollouts),
        num_gradient_rollouts=jnp.asarray(0),
        diagnosis=Diagnosis.fine,
        alpha=number(alpha),
        reason=Reason.fixed,
        bias_bound=number(bias_bound),
    )


def exact(objective, params, key):
    """The gradient of the bowl itself, one rollout."""
    return made_up(CURVATURE * (params - CENTRE), cost=bowl(params))


def noisy(objective, params, key):
    """The same with noise on it, as wide as the objective's; cheap to compile."""
    noise = objective.sample_noise(key)
    return made_up(CURVATURE * (params - CENTRE) + noise, cost=bowl(params + noise), error=objective.stddev)
