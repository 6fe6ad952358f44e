"""The loop around an estimator: optimisers, budgets, smoothing that decreases, runs that can be resumed."""

from mjxgrad.optimiser.convergence import Convergence
from mjxgrad.optimiser.descent import optimise
from mjxgrad.optimiser.gradient import EstimatedGradientState, estimated_gradient
from mjxgrad.optimiser.loop import RunOptions, run
from mjxgrad.optimiser.method import Method, Record
from mjxgrad.optimiser.result import History, Optimisation, Progress, Stopped
from mjxgrad.optimiser.smoothing import Plateau
from mjxgrad.optimiser.trust_region import TrustRegion

__all__ = [
    "Convergence",
    "EstimatedGradientState",
    "History",
    "Method",
    "Optimisation",
    "Plateau",
    "Progress",
    "Record",
    "RunOptions",
    "Stopped",
    "TrustRegion",
    "estimated_gradient",
    "optimise",
    "run",
]
