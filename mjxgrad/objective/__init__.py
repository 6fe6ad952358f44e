"""Objectives for estimators: tasks with a cost, policies that choose controls, and noise with its score."""

from mjxgrad.objective.actions import ActionNoise, OpenLoop, closed_loop, linear_policy, open_loop
from mjxgrad.objective.base import (
    Differentiated,
    Objective,
    ParameterNoise,
    as_vector,
    flattened,
    of_vector,
    parameter_noise,
)
from mjxgrad.objective.task import SceneTask
