"""The numbers of an experiment on bounces, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from experiments.bounce.settings import ImpedanceSettings, Settings
from experiments.motion import DISCRETE
from mjxgrad.diagnostics import SlopeComparison


@dataclass(frozen=True)
class Cell:
    """One contact.

    Attributes:
        damping_ratio: second number of `solref`.
        time_constant: first number of `solref`, in s.
        impedance: of `solimp`.
        truth: the derivative of the continuous motion, less the restitution, by quadrature.
        closed_form: the same in closed form; NaN where the impedance varies.
        duration: of the contact, in s.
    """

    damping_ratio: float
    time_constant: float
    impedance: ImpedanceSettings
    truth: float
    closed_form: float
    duration: float


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        settings: of the run.
        cells: the contacts.
        found: by arm its derivative beside the slope of its own height, one comparison per time step, by cell.
        tiny: mean over the phases of central differences far shorter than a time step, by time step and cell.
        wide: the same with differences as long as the ball flies in one step.
        wide_spread: standard deviation of these over the phases.
    """

    settings: Settings
    cells: list[Cell]
    found: dict[str, list[SlopeComparison]]
    tiny: Float[np.ndarray, "timesteps cells"]
    wide: Float[np.ndarray, "timesteps cells"]
    wide_spread: Float[np.ndarray, "timesteps cells"]

    @property
    def timesteps(self) -> Float[np.ndarray, " timesteps"]:
        """In s."""
        return np.array(self.settings.timesteps)

    def slope(self, arm: str = DISCRETE) -> Float[np.ndarray, "timesteps cells"]:
        """Give the slope of the simulated height, MuJoCo's unless said."""
        return np.array([one.slope for one in self.found[arm]])

    def mean(self, arm: str) -> Float[np.ndarray, "timesteps cells"]:
        """Give the mean of a derivative over the phases."""
        return np.array([one.mean[0] for one in self.found[arm]])

    def spread(self, arm: str) -> Float[np.ndarray, "timesteps cells"]:
        """Give the standard deviation of a derivative over the phases."""
        return np.array([one.spread[0] for one in self.found[arm]])

    def error(self, arm: str) -> Float[np.ndarray, "timesteps cells"]:
        """Give the error of a derivative as a share of the slope of its own height; 1 where it is larger."""
        return np.array([one.relative_error[0] for one in self.found[arm]])

    @property
    def is_stable(self) -> Bool[np.ndarray, "timesteps cells"]:
        r"""Whether the step can follow the contact: $h / t_c < 2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$."""
        ratio = np.array([cell.damping_ratio for cell in self.cells])
        limit = 2 * ratio * (np.sqrt(1 + ratio**2) - ratio) * np.array([cell.time_constant for cell in self.cells])
        return self.timesteps[:, None] < limit

    @property
    def can_judge(self) -> Bool[np.ndarray, "timesteps cells"]:
        """Where the slopes of all arms are known well enough, and the step is stable."""
        tolerance = self.settings.tolerance
        known = [[one.slope_error <= tolerance * np.abs(one.slope) for one in each] for each in self.found.values()]
        return np.array(known).all(axis=0) & self.is_stable

    def holds(self, arm: str) -> Bool[np.ndarray, "timesteps cells"]:
        """Say where a derivative is within the tolerance."""
        close = np.array([one.is_close(self.settings.tolerance)[0] for one in self.found[arm]])
        return self.can_judge & close

    def fails(self, arm: str) -> Bool[np.ndarray, "timesteps cells"]:
        """Say where it is beyond the tolerance by more than two standard errors; else more phases would be needed to tell."""
        off = np.array([one.is_off(self.settings.tolerance)[0] for one in self.found[arm]])
        return self.can_judge & off

    @property
    def steps_in_contact(self) -> Float[np.ndarray, "timesteps cells"]:
        """How many steps the contact lasts."""
        return np.array([cell.duration for cell in self.cells]) / self.timesteps[:, None]

    def rows(self) -> list[dict[str, Any]]:
        """One row per contact and time step, for metrics.csv."""
        columns = {}
        for arm in self.found:
            columns |= {
                arm: self.mean(arm),
                f"{arm} slope": self.slope(arm),
                f"{arm} slope error": np.array([one.slope_error for one in self.found[arm]]),
                f"{arm} spread": self.spread(arm),
                f"{arm} error": self.error(arm),
                f"{arm} holds": self.holds(arm),
                f"{arm} fails": self.fails(arm),
            }
        columns |= {
            "finite_difference_tiny": self.tiny,
            "finite_difference_wide": self.wide,
            "finite_difference_wide_spread": self.wide_spread,
            "steps_in_contact": self.steps_in_contact,
            "is_stable": self.is_stable,
            "can_judge": self.can_judge,
        }
        return [
            {
                "damping_ratio": cell.damping_ratio,
                "time_constant": cell.time_constant,
                "impedance_first": cell.impedance.first,
                "impedance_last": cell.impedance.last,
                "width": cell.impedance.width,
                "timestep": float(timestep),
                "truth": cell.truth,
                "closed_form": cell.closed_form,
                **{name: values[i, j].item() for name, values in columns.items()},
            }
            for j, cell in enumerate(self.cells)
            for i, timestep in enumerate(self.timesteps)
        ]
