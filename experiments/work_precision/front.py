"""Which ways no other beats in time and error at once."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool


def pareto_front(costs: Sequence[float], errors: Sequence[float]) -> Bool[np.ndarray, " points"]:
    """Say which points no other beats in cost and error at once.

    Args:
        costs: of the points.
        errors: of the points; what is not finite is on no front.

    Returns:
        One truth value per point. Of equal points all are on the front.
    """
    cost, error = np.asarray(costs, float), np.asarray(errors, float)
    is_beaten = np.zeros(len(cost), bool)
    for at in range(len(cost)):
        no_worse = (cost <= cost[at]) & (error <= error[at])
        is_beaten[at] = (no_worse & ((cost < cost[at]) | (error < error[at]))).any()
    return ~is_beaten & np.isfinite(error) & np.isfinite(cost)
