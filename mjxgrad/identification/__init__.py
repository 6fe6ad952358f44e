"""Parameters of a scene from recorded motions, through contact."""

from mjxgrad.identification.parameters import (
    Parameter,
    armature,
    damping,
    friction,
    friction_loss,
    gains,
    gear,
    inertia,
    mass,
    number,
    softness,
)
from mjxgrad.identification.recording import Recording
from mjxgrad.identification.result import Identification, Outlook, Stopped
from mjxgrad.identification.search import identify, outlook

__all__ = [
    "Identification", "Outlook", "Parameter", "Recording", "Stopped", "armature", "damping", "friction", "friction_loss",
    "gains", "gear", "identify", "inertia", "mass", "number", "outlook", "softness",
]  # fmt: skip
