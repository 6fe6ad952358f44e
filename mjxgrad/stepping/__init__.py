"""The differentiable step: rows of contacts, limits and equalities, time integration, onset and smoothing."""

from mjxgrad.stepping.contact import (
    Contact,
    Discrete,
    EngineName,
    Gradient,
    Onset,
    OwnMotion,
    Slope,
    Smoothing,
    check_contact,
    own_motion,
)
from mjxgrad.stepping.forward import forward, solve
from mjxgrad.stepping.rows import contact_force
from mjxgrad.stepping.smoothing import smoothing_warnings
from mjxgrad.stepping.step import step
