"""The differentiable step: rows of contacts, limits and equalities, time integration, onset and smoothing."""

from mjxgrad.stepping.onset import Onset
from mjxgrad.stepping.rows import contact_force
from mjxgrad.stepping.smoothing import Smoothing, smoothing_warnings
from mjxgrad.stepping.step import Gradient, check_gradient, forward, solve, step

__all__ = [
    "Gradient",
    "Onset",
    "Smoothing",
    "check_gradient",
    "contact_force",
    "forward",
    "smoothing_warnings",
    "solve",
    "step",
]
