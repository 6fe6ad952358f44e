"""One step that can be differentiated."""

from mjxgrad.dynamics.contact_forces import contact_force
from mjxgrad.dynamics.onset import Onset
from mjxgrad.dynamics.step import Gradient, check_gradient, forward, solve, step

__all__ = ["Gradient", "Onset", "check_gradient", "contact_force", "forward", "solve", "step"]
