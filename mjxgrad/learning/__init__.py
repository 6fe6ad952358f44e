"""Policies learned through contact: short windows with a value function, by first order, zeroth order, or a mixture."""

from mjxgrad.learning.evaluate import Evaluation, evaluate
from mjxgrad.learning.learn import Learned, learn
from mjxgrad.learning.learner import Learner, Policy
from mjxgrad.learning.settings import Bundle, Settings
from mjxgrad.loop.run import Log

__all__ = ["Bundle", "Evaluation", "Learned", "Learner", "Log", "Policy", "Settings", "evaluate", "learn"]
