"""Planning through contact: trajectory optimisation on smoothed linear models, and control by it."""

from mjxgrad.planning.controller import Controller
from mjxgrad.planning.linear_model import Analytic, Exact, LinearModel, Sampled, Smoother
from mjxgrad.planning.system import Cost, FunctionSystem, GoalCost, LeastSquares, SceneSystem, System
from mjxgrad.planning.trajectory import Iterations, Plan, optimise_trajectory
from mjxgrad.planning.tree import Tree, TreePath

__all__ = [
    "Analytic",
    "Controller",
    "Cost",
    "Exact",
    "FunctionSystem",
    "GoalCost",
    "Iterations",
    "LeastSquares",
    "LinearModel",
    "Plan",
    "Sampled",
    "SceneSystem",
    "Smoother",
    "System",
    "Tree",
    "TreePath",
    "optimise_trajectory",
]
