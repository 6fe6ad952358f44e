"""What one would otherwise use, in the same loop, with rollouts counted alike.

They are written here, for each is short, and a library of them would bring in a neural-network framework.
"""

from mjxgrad.baselines.cross_entropy import cross_entropy
from mjxgrad.baselines.path_integral import mppi, predictive_sampling

__all__ = ["cross_entropy", "mppi", "predictive_sampling"]
