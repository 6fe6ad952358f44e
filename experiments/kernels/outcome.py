"""The numbers of an experiment on smoothing kernels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.kernels.settings import Settings
from mjxgrad.diagnostics.equivalent_noise import EquivalentNoise

TITLES = {"gaussian": "Gaussian", "logistic": "logistic", "log_barrier": "log barrier"}
# Derivatives of the velocity after a step, and what they are by: two entries of A and the one of B.
ENTRIES = ("velocity by height (1/s)", "velocity by velocity", "velocity by force (1/N)")
WAYS = ("smoothed solver", "mean of derivatives", "zeroth order")


@dataclass(frozen=True)
class Profile:
    """One contact's static force against distance, and what noise it is.

    Attributes:
        name: for legends.
        distance: between the bodies (m).
        force: per mass (N/kg).
        found: the equivalent noise.
    """

    name: str
    distance: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    found: EquivalentNoise


@dataclass(frozen=True)
class Motion:
    """A ball that meets the plane, smoothed and sampled.

    Attributes:
        height: of the smoothed rollout (m), by step.
        slope: of the height by the start height.
        sampled: mean height over rollouts with noise in each step (m).
        sampled_error: its standard error.
        sampled_slope: by differences with common noise.
        sampled_slope_error: its standard error.
    """

    height: Float[np.ndarray, " steps"]
    slope: Float[np.ndarray, " steps"]
    sampled: Float[np.ndarray, " steps"]
    sampled_error: Float[np.ndarray, " steps"]
    sampled_slope: Float[np.ndarray, " steps"]
    sampled_slope_error: Float[np.ndarray, " steps"]


@dataclass(frozen=True)
class Linear:
    """A and B of one step at one velocity, in the order of `ENTRIES` and `WAYS`.

    Attributes:
        velocity: at which (m/s).
        value: the derivatives.
        error: their standard errors, zero where nothing is sampled.
    """

    velocity: float
    value: Float[np.ndarray, "entries ways"]
    error: Float[np.ndarray, "entries ways"]

    @property
    def deviation(self) -> Float[np.ndarray, "entries ways"]:
        """Distance from the smoothed solver's, in standard errors."""
        error = np.where(self.error > 0, self.error, np.inf)
        return np.abs(self.value - self.value[:, :1]) / error


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        profiles: forces at a distance.
        time: of the motion's states (s).
        hard: height without noise (m).
        hard_slope: its derivative, that of the simulated map.
        motions: by kernel.
        linear: by kernel, at rest and approaching.
    """

    settings: Settings
    profiles: list[Profile]
    time: Float[np.ndarray, " steps"]
    hard: Float[np.ndarray, " steps"]
    hard_slope: Float[np.ndarray, " steps"]
    motions: dict[str, Motion]
    linear: dict[str, list[Linear]]

    def rows(self) -> list[dict[str, Any]]:
        """One row per kernel, state, entry and way, for metrics.csv."""
        return [
            {
                "kernel": kernel,
                "velocity": one.velocity,
                "entry": entry,
                "way": way,
                "value": float(one.value[i, j]),
                "standard_error": float(one.error[i, j]),
            }
            for kernel, states in self.linear.items()
            for one in states
            for i, entry in enumerate(ENTRIES)
            for j, way in enumerate(WAYS)
        ]
