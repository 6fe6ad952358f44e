"""The cost and the noise of each scene in mjcf/."""

from mjxgrad.task import Outcome, SceneTask, Task
from mjxgrad.tasks import published, textbook
from mjxgrad.tasks.action_task import ActionTask, scene_path
from mjxgrad.tasks.ball_wall import BallWall, ball_wall, wall_softness
from mjxgrad.tasks.billiards import Billiards, billiards
from mjxgrad.tasks.hopper import hopper
from mjxgrad.tasks.planar_pusher import PlanarPusher, planar_pusher
from mjxgrad.tasks.published_scenes import friction, motion_planning, push, push_softness, tennis
from mjxgrad.tasks.rolling_pin import RollingPin, rolling_pin

__all__ = [
    "ActionTask",
    "BallWall",
    "Billiards",
    "Outcome",
    "PlanarPusher",
    "RollingPin",
    "SceneTask",
    "Task",
    "ball_wall",
    "billiards",
    "friction",
    "hopper",
    "motion_planning",
    "planar_pusher",
    "published",
    "push",
    "push_softness",
    "rolling_pin",
    "scene_path",
    "tennis",
    "textbook",
    "wall_softness",
]
