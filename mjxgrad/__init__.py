"""mjxgrad: differentiable rollouts on MuJoCo MJX whose gradients can be trusted, and a measure of how far."""

from mjxgrad.dynamics import forward, solve, step
from mjxgrad.rollout import (
    DivergedError,
    State,
    Trajectory,
    check_trajectory,
    initial_state,
    rollout,
)
from mjxgrad.scene import Scene, load_scene
from mjxgrad.softness import Softness

__all__ = [
    "DivergedError",
    "Scene",
    "Softness",
    "State",
    "Trajectory",
    "check_trajectory",
    "forward",
    "initial_state",
    "load_scene",
    "rollout",
    "solve",
    "step",
]
