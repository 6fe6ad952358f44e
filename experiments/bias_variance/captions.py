"""What each figure shows and how to read it."""

from experiments.bias_variance.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    percent = f"{outcome.confidence:.0%}"
    default = " The diamond on the dashed line is MuJoCo's default contact." if outcome.has_default else ""
    return {
        "landscape": (
            "Left, one rollout per angle: where a blocked throw becomes one that clears the wall the cost jumps, and "
            "the stiffer the wall the sharper. Right, what noise makes of it, and what both estimates are to "
            "differentiate. Dotted lines mark the angles examined below."
        ),
        "gradient": (
            f"Mean of {outcome.num_samples} samples with its {percent} interval, at each angle. The reference comes "
            f"from rollouts of its own; the grey band is its interval. Intervals that leave a panel are cut.{default}"
        ),
        "bias_variance": (
            f"Above, the mean of the first-order estimate less the reference, with the {percent} interval of the "
            "difference; filled where it differs from zero beyond chance over all cases, hollow where it does not. "
            f"Below, the variance of a single sample, with {percent} bootstrap intervals.{default}"
        ),
        "choice": (
            f"Root of squared bias plus variance over {outcome.budget}, of first order divided by that of zeroth "
            "order: orange, and below 1, where first order is closer to the truth, blue where zeroth order is. A bias "
            "counts where it is beyond chance (*); † marks the wrong sign."
        ),
    }
