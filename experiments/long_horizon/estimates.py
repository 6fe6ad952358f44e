"""Gradients of mean costs from values alone: the zeroth-order estimate, and a reference with less noise."""

import numpy as np
from jaxtyping import Float

from experiments.long_horizon.settings import Sizes


def zeroth(
    stddev: float, noise: Float[np.ndarray, "samples dim"], costs: Float[np.ndarray, "samples times"], sizes: Sizes
) -> Float[np.ndarray, "samples times dim"]:
    """Give samples of the zeroth-order gradient, with the mean of each estimate's other costs as baseline.

    Args:
        stddev: of the noise.
        noise: on the parameters.
        costs: under it.
        sizes: how many samples make an estimate.
    """
    groups = costs.reshape(sizes.num_repeats, sizes.num_samples, -1)
    others = (groups.sum(axis=1, keepdims=True) - groups) / (sizes.num_samples - 1)
    return ((groups - others).reshape(costs.shape))[:, :, None] * (noise / stddev**2)[:, None]


def reference_gradient(
    stddev: float, pilot: tuple[np.ndarray, np.ndarray], many: tuple[np.ndarray, np.ndarray]
) -> tuple[Float[np.ndarray, "times dim"], Float[np.ndarray, "times dim"]]:
    """Give the gradient of the mean costs from values alone, and its standard error.

    Args:
        stddev: of the noise.
        pilot: noise and costs of other rollouts, whose mean and slopes are taken out.
        many: noise and costs.

    Returns:
        One row per time each.
    """
    noise, costs = pilot
    slopes = np.linalg.lstsq(noise, costs - costs.mean(axis=0), rcond=None)[0]
    rest = many[1] - costs.mean(axis=0) - many[0] @ slopes
    samples = rest[:, :, None] * (many[0] / stddev**2)[:, None]
    return slopes.T + samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
