"""Rollouts of a scene, with initial states, linear models and rendering."""

from mjxgrad.engines import DivergedError, Observe, Policy, Sees, State, Trajectory
from mjxgrad.rollouts.linearisation import Linearisation, linearise
from mjxgrad.rollouts.rollout import rollout
from mjxgrad.rollouts.start import initial_state
