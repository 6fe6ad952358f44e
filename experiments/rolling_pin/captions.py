"""What each figure shows and how to read it."""

from experiments.rolling_pin.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    reach = outcome.settings.remedies
    return {
        "descent": (
            "True cost against steps, left, and against rollouts, right: every descent is judged by the same scene, "
            "without noise and without its remedy. The dotted line is what counts as solved. At first the pin is "
            f"{1e3 * reach.radius:g} mm larger, the margin {1e3 * reach.margin:g} mm wide, the kernel "
            f"{1e3 * reach.length:g} mm long; all shrink to {reach.last:.0%} on the way, so that what is seen becomes "
            "what is."
        ),
        "bed": (
            "Heights of the eight pillars in the end, under the true motion; grey, the dent that was asked for. The pin "
            "starts above the third."
        ),
    }
