"""The cost and the noise of each scene in mjcf/."""

from mjxgrad.task import Outcome, SceneTask, Task
from mjxgrad.tasks import published, textbook
from mjxgrad.tasks.action_task import ActionTask
from mjxgrad.tasks.ball_wall import BallWall, ball_wall, wall_softness
from mjxgrad.tasks.billiards import Billiards, billiards
from mjxgrad.tasks.cube_toss import CubeToss, cube_toss
from mjxgrad.tasks.friction import friction
from mjxgrad.tasks.hopper import hopper
from mjxgrad.tasks.motion_planning import motion_planning
from mjxgrad.tasks.planar_pusher import PlanarPusher, planar_pusher
from mjxgrad.tasks.push import push, push_softness
from mjxgrad.tasks.rolling_pin import RollingPin, rolling_pin
from mjxgrad.tasks.tennis import tennis

__all__ = [
    "ActionTask",
    "BallWall",
    "Billiards",
    "CubeToss",
    "Outcome",
    "PlanarPusher",
    "RollingPin",
    "SceneTask",
    "Task",
    "ball_wall",
    "billiards",
    "cube_toss",
    "friction",
    "hopper",
    "motion_planning",
    "planar_pusher",
    "published",
    "push",
    "push_softness",
    "rolling_pin",
    "tennis",
    "textbook",
    "wall_softness",
]
