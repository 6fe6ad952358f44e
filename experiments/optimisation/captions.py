"""What each figure shows and how to read it."""

from experiments.optimisation.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    settings = outcome.settings
    percent = f"{settings.confidence:.0%}"
    published = "; diamonds are published means ± standard deviations" if outcome.reference else ""
    errors = (
        f" Right, distance of one estimate at the start to the gradient, over its norm: root mean square of "
        f"{settings.error_repeats} estimates of {outcome.num_samples} rollouts, with its {percent} interval; the gradient "
        f"is an unbiased estimate from {settings.reference_samples} rollouts."
        if outcome.errors is not None
        else ""
    )
    return {
        "final": (
            f"Left, dots are seeds, bars the means with their {percent} intervals{published}. An arrow stands for a mean "
            f"± standard deviation beyond the panel.{errors}"
        ),
        "curves": (
            f"Lines are medians over {settings.seeds} seeds, bands reach from the lowest to the highest. The axis is the "
            "cost above the lowest that any run has met, so a line that ends low on the logarithmic scale is as good as "
            "the best; below, what one would otherwise use, with α-order for comparison. Both columns are of the same "
            "runs; the seconds include the measurement of the noise-free cost, which is no rollout of the method."
        ),
        "alpha": (
            "Left, the weight of the first-order part, the mean over seeds and over a fiftieth of the steps; where "
            "there are several blocks, over these, too. Right, how often each reason settled it."
        ),
    }
