"""Scenes with a cost and noise: a throw over a wall, gymnasium's hopper, and the classes for your own."""

from mjxgrad.objective.task import Outcome, SceneTask, Task
from mjxgrad.tasks.action_task import ActionTask, scene_path
from mjxgrad.tasks.ball_wall import BallWall, ball_wall, wall_softness
from mjxgrad.tasks.hopper import hopper

__all__ = [
    "ActionTask",
    "BallWall",
    "Outcome",
    "SceneTask",
    "Task",
    "ball_wall",
    "hopper",
    "scene_path",
    "wall_softness",
]
