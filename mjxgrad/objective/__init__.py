"""Objectives for estimators: tasks with a cost, policies that choose controls, and noise with its score."""

from mjxgrad.objective.actions import ActionNoise, ClosedLoop, OpenLoop, closed_loop, linear_policy, open_loop
from mjxgrad.objective.base import Differentiated, Objective
from mjxgrad.objective.parameters import ParameterNoise, as_vector, flattened, of_vector, parameter_noise
from mjxgrad.objective.task import Outcome, SceneTask, Task

__all__ = [
    "ActionNoise",
    "ClosedLoop",
    "Differentiated",
    "Objective",
    "OpenLoop",
    "Outcome",
    "ParameterNoise",
    "SceneTask",
    "Task",
    "as_vector",
    "closed_loop",
    "flattened",
    "linear_policy",
    "of_vector",
    "open_loop",
    "parameter_noise",
]
