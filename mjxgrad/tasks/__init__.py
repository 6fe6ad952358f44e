"""The cost and the noise of each scene in mjcf/."""

from mjxgrad.task import Outcome, SceneTask, Task
from mjxgrad.tasks import published, textbook
from mjxgrad.tasks.ball_wall import BallWall, ball_wall, wall_softness

__all__ = ["BallWall", "Outcome", "SceneTask", "Task", "ball_wall", "published", "textbook", "wall_softness"]
