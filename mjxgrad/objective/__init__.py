"""What an estimator sees: a value under noise, the score of that noise, and both by the noisy quantity."""

from mjxgrad.objective.actions import ActionNoise, ClosedLoop, OpenLoop, closed_loop, open_loop
from mjxgrad.objective.base import Differentiated, Objective
from mjxgrad.objective.parameters import ParameterNoise, as_vector, flattened, of_vector, parameter_noise

__all__ = [
    "ActionNoise",
    "ClosedLoop",
    "Differentiated",
    "Objective",
    "OpenLoop",
    "ParameterNoise",
    "as_vector",
    "closed_loop",
    "flattened",
    "of_vector",
    "open_loop",
    "parameter_noise",
]
