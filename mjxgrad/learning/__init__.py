"""Policies learned through contact: short windows with a value function, by first order, zeroth order, or a mixture."""

from mjxgrad.learning.evaluate import Evaluation, evaluate
from mjxgrad.learning.learn import Learned, learn
from mjxgrad.learning.learner import Learner, Policy, Settings, apg
from mjxgrad.learning.logs import Log, to_all, to_csv, to_tensorboard, to_tracker

__all__ = [
    "Evaluation",
    "Learned",
    "Learner",
    "Log",
    "Policy",
    "Settings",
    "apg",
    "evaluate",
    "learn",
    "to_all",
    "to_csv",
    "to_tensorboard",
    "to_tracker",
]
