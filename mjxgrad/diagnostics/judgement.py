"""What it means that a derivative is, or is not, the slope of the simulated outcome."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

ROUNDINGS = 1e3  # of the outcome's precision, that many steps may add up


class AgainstSlope(eqx.Module):
    """Means of derivatives beside a slope, each with its standard error, and what follows.

    Attributes:
        gradients: names of the derivatives, in the order of their axis. The first is what errors are measured beside.
        slope: of the simulated outcome.
        slope_error: its standard error.
        mean: of each derivative, weighted as the slope is.
        mean_error: its standard error.
        spread: standard deviation of each derivative.
        resolution: what rounding of the outcome leaves of a slope; smaller errors are none.
    """

    gradients: eqx.AbstractVar[tuple[str, ...]]
    slope: eqx.AbstractVar[Float[np.ndarray, "*outcome"]]
    slope_error: eqx.AbstractVar[Float[np.ndarray, "*outcome"]]
    mean: eqx.AbstractVar[Float[np.ndarray, "gradients *outcome"]]
    mean_error: eqx.AbstractVar[Float[np.ndarray, "gradients *outcome"]]
    spread: eqx.AbstractVar[Float[np.ndarray, "gradients *outcome"]]
    resolution: eqx.AbstractVar[Float[np.ndarray, "*outcome"]]

    @property
    @abc.abstractmethod
    def standard_error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Of `error`."""

    @property
    @abc.abstractmethod
    def is_regular(self) -> Bool[np.ndarray, "*outcome"]:
        """Where there is a slope to be compared with."""

    @property
    def error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Mean of each derivative less the slope."""
        return self.mean - self.slope

    @property
    def scale(self) -> Float[np.ndarray, "*outcome"]:
        """What errors are measured by: the larger of the slope and the error of the first derivative named."""
        # Where both are nothing but rounding, no error is to look large beside it.
        return np.asarray(np.maximum(np.maximum(np.abs(self.slope), np.abs(self.error[0])), self.resolution))

    @property
    def relative_error(self) -> Float[np.ndarray, "gradients *outcome"]:
        """Size of `error` beyond rounding, over `scale`."""
        size = np.abs(self.error)
        return np.where(size > self.resolution, size, 0 * size) / self.scale

    def is_close(self, tolerance: float = 0.05) -> Bool[np.ndarray, "gradients *outcome"]:
        """Say where the mean of a derivative is the slope to within `tolerance` times `scale`.

        Args:
            tolerance: as a share of `scale`.

        Returns:
            One truth value per derivative and outcome; False where numbers are not finite.
        """
        return self.relative_error <= tolerance

    def is_off(self, tolerance: float = 0.05) -> Bool[np.ndarray, "gradients *outcome"]:
        """Say where it is not, beyond two standard errors. What is neither close nor off needs more rollouts.

        Args:
            tolerance: as a share of `scale`.

        Returns:
            One truth value per derivative and outcome; False where numbers are not finite.
        """
        return np.abs(self.error) - 2 * self.standard_error > np.maximum(tolerance * self.scale, self.resolution)

    def is_resolved(self, tolerance: float = 0.05) -> Bool[np.ndarray, "*outcome"]:
        """Say where the slope is known well enough to judge by: its standard error is below `tolerance` times `scale`.

        Args:
            tolerance: as a share of `scale`.

        Returns:
            One truth value per outcome; False where numbers are not finite.
        """
        return np.asarray(self.slope_error <= np.maximum(tolerance * self.scale, self.resolution))
