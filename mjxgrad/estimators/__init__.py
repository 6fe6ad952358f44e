"""Estimates of the gradient of a smoothed objective, all with the same call."""

from mjxgrad.estimators import rules
from mjxgrad.estimators.alpha import alpha_order
from mjxgrad.estimators.control_variate import control_variate
from mjxgrad.estimators.estimate import Diagnosis, GradientEstimate, Reason
from mjxgrad.estimators.first import first_order
from mjxgrad.estimators.least_squares import least_squares
from mjxgrad.estimators.per_step import per_step
from mjxgrad.estimators.shared import first_and_zeroth_order
from mjxgrad.estimators.zeroth import zeroth_order

__all__ = [
    "Diagnosis",
    "GradientEstimate",
    "Reason",
    "alpha_order",
    "control_variate",
    "first_and_zeroth_order",
    "first_order",
    "least_squares",
    "per_step",
    "rules",
    "zeroth_order",
]
