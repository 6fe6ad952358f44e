"""The loop around an estimator: optimisers, annealing, runs that can be resumed."""

from mjxgrad.optimiser.result import History, Optimisation, Record, Stopped
from mjxgrad.optimiser.run import RunOptions, optimise, run
from mjxgrad.optimiser.step import EstimatedGradientState, Method, estimated_gradient

__all__ = [
    "EstimatedGradientState",
    "History",
    "Method",
    "Optimisation",
    "Record",
    "RunOptions",
    "Stopped",
    "estimated_gradient",
    "optimise",
    "run",
]
