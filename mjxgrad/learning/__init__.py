"""Policies learned through contact: short windows with a value function, by first order, zeroth order, or a mixture."""

from mjxgrad.learning.learn import Learned, Log, learn
from mjxgrad.learning.learner import Learner, Policy, Settings

__all__ = ["Learned", "Learner", "Log", "Policy", "Settings", "learn"]
