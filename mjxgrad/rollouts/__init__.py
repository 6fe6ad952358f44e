"""Rollouts of a scene by MJX or C MuJoCo, with states, trajectories, linear models and rendering."""

from mjxgrad.rollouts.arguments import Observe, Policy, Sees
from mjxgrad.rollouts.linearisation import Linearisation, linearise
from mjxgrad.rollouts.rollout import rollout
from mjxgrad.rollouts.state import DivergedError, State, Trajectory, initial_state
