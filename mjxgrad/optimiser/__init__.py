"""The loop around an estimator: optimisers, budgets, annealing, runs that can be resumed."""

from mjxgrad.optimiser.annealing import Plateau
from mjxgrad.optimiser.result import History, Optimisation, Record, Stopped
from mjxgrad.optimiser.run import RunOptions, optimise, run
from mjxgrad.optimiser.step import EstimatedGradientState, Method, TrustRegion, estimated_gradient
from mjxgrad.optimiser.stopping import Convergence

__all__ = [
    "Convergence",
    "EstimatedGradientState",
    "History",
    "Method",
    "Optimisation",
    "Plateau",
    "Record",
    "RunOptions",
    "Stopped",
    "TrustRegion",
    "estimated_gradient",
    "optimise",
    "run",
]
