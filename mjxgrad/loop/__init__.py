"""One loop for every method: optimisers, searches and learners, with logs, and runs that can be resumed."""

from mjxgrad.loop.optimise import estimated_gradient, optimise
from mjxgrad.loop.result import History, Optimisation, Stopped
from mjxgrad.loop.run import Method, run, side_by_side
