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
    softness,
)
from mjxgrad.identification.recording import Recording
from mjxgrad.identification.result import Identification, Stopped
from mjxgrad.identification.search import identify

__all__ = [
    "Identification", "Parameter", "Recording", "Stopped", "armature", "damping", "friction", "friction_loss", "gains", "gear",
    "identify", "inertia", "mass", "softness",
]  # fmt: skip
