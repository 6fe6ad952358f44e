"""Rollouts of a scene, with initial states, linear models and rendering."""

from mjxgrad.engines import DivergedError, Observe, PolicyFunction, Sees, State, Trajectory
from mjxgrad.rollouts.rollout import Linearisation, linearise, rollout
from mjxgrad.rollouts.start import initial_state
