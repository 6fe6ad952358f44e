"""How soft contacts are, and how far off they begin: what it is, which pairs it changes, when it has no effect."""

from mjxgrad.softness.advice import softness_warnings
from mjxgrad.softness.knob import Softness

__all__ = ["Softness", "softness_warnings"]
