"""Estimates of the gradient of a smoothed objective, all with the same call.

Each is compiled once per form of its arguments, and at each later call runs at once, also where the objective is made anew of
the same functions. As under `jax.jit`, what a cost reads besides its arguments is read only the first time.
"""

from mjxgrad.estimators import rules
from mjxgrad.estimators.estimate import Diagnosis, GradientEstimate, Reason
from mjxgrad.estimators.first_and_zeroth import first_and_zeroth_order, first_order, zeroth_order
from mjxgrad.estimators.least_squares import least_squares
from mjxgrad.estimators.mixture import alpha_order, control_variate
from mjxgrad.estimators.per_step import per_step_inverse_variance, reinforce

__all__ = [
    "Diagnosis",
    "GradientEstimate",
    "Reason",
    "alpha_order",
    "control_variate",
    "first_and_zeroth_order",
    "first_order",
    "least_squares",
    "per_step_inverse_variance",
    "reinforce",
    "rules",
    "zeroth_order",
]
