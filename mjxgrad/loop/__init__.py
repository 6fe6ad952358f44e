"""One loop for every method: optimisers, searches and learners, with logs, and runs that can be resumed."""

from mjxgrad.loop.descent import Descent, RunOptions
from mjxgrad.loop.optimise import EstimatedGradientState, estimated_gradient, optimise
from mjxgrad.loop.result import History, Optimisation, Record, Stopped
from mjxgrad.loop.run import Log, Method, Progress, run, side_by_side

__all__ = [
    "Descent",
    "EstimatedGradientState",
    "History",
    "Log",
    "Method",
    "Optimisation",
    "Progress",
    "Record",
    "RunOptions",
    "Stopped",
    "estimated_gradient",
    "optimise",
    "run",
    "side_by_side",
]
