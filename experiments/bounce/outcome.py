"""The numbers of an experiment on bounces, and what follows from them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from experiments.bounce.settings import BounceSettings, ImpedanceSettings
from mjxgrad.diagnostics import SlopeComparison

DISCRETE, EVENT = "discrete", "event"


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
        found: derivatives beside the slope, one comparison per time step, by cell.
        tiny: mean over the phases of central differences far shorter than a time step, by time step and cell.
        wide: the same with differences as long as the ball flies in one step.
        wide_spread: standard deviation of these over the phases.
    """

    settings: BounceSettings
    cells: list[Cell]
    found: list[SlopeComparison]
    tiny: Float[np.ndarray, "timesteps cells"]
    wide: Float[np.ndarray, "timesteps cells"]
    wide_spread: Float[np.ndarray, "timesteps cells"]

    @property
    def timesteps(self) -> Float[np.ndarray, " timesteps"]:
        """In s."""
        return np.array(self.settings.timesteps)

    @property
    def slope(self) -> Float[np.ndarray, "timesteps cells"]:
        """Of the simulated height."""
        return np.array([one.slope for one in self.found])

    def mean(self, gradient: str) -> Float[np.ndarray, "timesteps cells"]:
        """Give the mean of a derivative over the phases.

        Args:
            gradient: its name.
        """
        return np.array([one.mean[one.gradients.index(gradient)] for one in self.found])

    def spread(self, gradient: str) -> Float[np.ndarray, "timesteps cells"]:
        """Give the standard deviation of a derivative over the phases.

        Args:
            gradient: its name.
        """
        return np.array([one.spread[one.gradients.index(gradient)] for one in self.found])

    def error(self, gradient: str) -> Float[np.ndarray, "timesteps cells"]:
        """Give the error of a derivative as a share of the larger of the slope and the discrete one's own error.

        Args:
            gradient: its name.
        """
        return np.array([one.relative_error[one.gradients.index(gradient)] for one in self.found])

    @property
    def share_of_slope(self) -> Float[np.ndarray, "timesteps cells"]:
        """Give the error of the event gradient as a share of the slope alone."""
        return np.abs(self.mean(EVENT) - self.slope) / np.abs(self.slope)

    @property
    def is_stable(self) -> Bool[np.ndarray, "timesteps cells"]:
        r"""Whether the step can follow the contact: $h / t_c < 2 \zeta (\sqrt{1 + \zeta^2} - \zeta)$."""
        ratio = np.array([cell.damping_ratio for cell in self.cells])
        limit = 2 * ratio * (np.sqrt(1 + ratio**2) - ratio) * np.array([cell.time_constant for cell in self.cells])
        return self.timesteps[:, None] < limit

    @property
    def can_judge(self) -> Bool[np.ndarray, "timesteps cells"]:
        """Where the slope is known well enough, and the step is stable."""
        tolerance = self.settings.tolerance
        return np.array([one.is_resolved(tolerance) for one in self.found]) & self.is_stable

    @property
    def holds(self) -> Bool[np.ndarray, "timesteps cells"]:
        """Where the event gradient is within the tolerance."""
        return self.can_judge & self._said("is_close")

    @property
    def fails(self) -> Bool[np.ndarray, "timesteps cells"]:
        """Where it is beyond the tolerance by more than two standard errors; elsewhere more phases would be needed."""
        return self.can_judge & self._said("is_off")

    def _said(self, question: str) -> Bool[np.ndarray, "timesteps cells"]:
        answers = [getattr(one, question)(self.settings.tolerance) for one in self.found]
        return np.array([answer[one.gradients.index(EVENT)] for answer, one in zip(answers, self.found, strict=True)])

    @property
    def steps_in_contact(self) -> Float[np.ndarray, "timesteps cells"]:
        """How many steps the contact lasts."""
        return np.array([cell.duration for cell in self.cells]) / self.timesteps[:, None]

    def rows(self) -> list[dict[str, Any]]:
        """One row per contact and time step, for metrics.csv."""
        columns = {
            "slope": self.slope,
            "slope_error": np.array([one.slope_error for one in self.found]),
            **{name: self.mean(name) for name in (DISCRETE, EVENT)},
            **{f"{name}_spread": self.spread(name) for name in (DISCRETE, EVENT)},
            **{f"{name}_relative_error": self.error(name) for name in (DISCRETE, EVENT)},
            "event_share_of_slope": self.share_of_slope,
            "finite_difference_tiny": self.tiny,
            "finite_difference_wide": self.wide,
            "finite_difference_wide_spread": self.wide_spread,
            "steps_in_contact": self.steps_in_contact,
            "is_stable": self.is_stable,
            "can_judge": self.can_judge,
            "holds": self.holds,
            "fails": self.fails,
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
