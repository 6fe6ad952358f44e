"""One step that can be differentiated."""

from mjxgrad.dynamics.constants import set_const
from mjxgrad.dynamics.onset import Onset
from mjxgrad.dynamics.rows import contact_force
from mjxgrad.dynamics.smoothing import Smoothing, smoothing_warnings
from mjxgrad.dynamics.stepping import Gradient, check_gradient, forward, solve, step

__all__ = [
    "Gradient",
    "Onset",
    "Smoothing",
    "check_gradient",
    "contact_force",
    "forward",
    "set_const",
    "smoothing_warnings",
    "solve",
    "step",
]
