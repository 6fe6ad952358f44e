"""What an estimator sees: a value under noise, the score of that noise, and both by the noisy quantity."""

from mjxgrad.objective.actions import ActionNoise, ClosedLoop, OpenLoop, closed_loop, open_loop
from mjxgrad.objective.base import Differentiated, Objective
from mjxgrad.objective.derivative import value_and_gradient
from mjxgrad.objective.parameters import ParameterNoise, parameter_noise

__all__ = [
    "ActionNoise",
    "ClosedLoop",
    "Differentiated",
    "Objective",
    "OpenLoop",
    "ParameterNoise",
    "closed_loop",
    "open_loop",
    "parameter_noise",
    "value_and_gradient",
]
