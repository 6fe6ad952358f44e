"""Many steps of a scene: states and trajectories, by MJX or C MuJoCo; linear models, adaptive integration, pictures of them."""

from mjxgrad.rollouts.arguments import Engine, Observe, Policy, Sees
from mjxgrad.rollouts.linearisation import Linearisation, linearise
from mjxgrad.rollouts.rollout import rollout
from mjxgrad.rollouts.state import State, initial_state
from mjxgrad.rollouts.trajectory import DivergedError, Trajectory, check_trajectory

__all__ = [
    "DivergedError",
    "Engine",
    "Linearisation",
    "Observe",
    "Policy",
    "Sees",
    "State",
    "Trajectory",
    "check_trajectory",
    "initial_state",
    "linearise",
    "rollout",
]
