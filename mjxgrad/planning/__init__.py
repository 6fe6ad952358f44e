"""Plans through contact: trajectory optimisation and search trees, both on smoothed linear models."""

from mjxgrad.planning.linear_model import Analytic, Exact, LinearModel, Sampled, Smoother
from mjxgrad.planning.system import Cost, FunctionSystem, GoalCost, SceneSystem, System
from mjxgrad.planning.trajectory import Iterations, Plan, optimise_trajectory, shifted
from mjxgrad.planning.tree import Path, Sampling, Search, path, search

__all__ = [
    "Analytic",
    "Cost",
    "Exact",
    "FunctionSystem",
    "GoalCost",
    "Iterations",
    "LinearModel",
    "Path",
    "Plan",
    "Sampled",
    "Sampling",
    "SceneSystem",
    "Search",
    "Smoother",
    "System",
    "optimise_trajectory",
    "path",
    "search",
    "shifted",
]
