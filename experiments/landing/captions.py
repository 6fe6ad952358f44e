"""What each figure shows and how to read it."""

from experiments.landing.outcome import Outcome
from experiments.landing.settings import LandingSettings


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    settings = outcome.settings
    return {
        "error": (
            "One dot per time and coordinate after the first impact, where the slope can be judged by; discs are medians. "
            "Errors below 10⁻⁴ and above 10² are drawn there. "
            f"Left of the dotted line an error is at most {settings.tolerance:.0%}."
        ),
        "derivative": (
            f"Black, slope of the simulated position over {_starts(settings)}; colours, means of the derivatives at the same "
            "starts; bands, two standard errors. Positions and starts are in m or rad. Where the discrete gradient leaves the "
            "panel it is cut."
        ),
        "next": "As the figure before.",
    }


def _starts(settings: LandingSettings) -> str:
    if settings.average_over == "phases":
        return f"{settings.num_phases} starts"
    return (
        f"{settings.num_samples} starts, whose joints differ by {settings.position_stddev:g} rad and velocities by "
        f"{settings.velocity_stddev:g} m/s or rad/s at random"
    )
