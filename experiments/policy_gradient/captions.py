"""What each figure shows and how to read it."""

from experiments.policy_gradient.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    settings = outcome.settings
    return {
        "summary": (
            "Left, norm of the bias over the norm of the gradient, noise taken off, with two standard errors; where the "
            "interval reaches the edge no bias was found. Middle, mean weight of the first order. Right, "
            "root-mean-square error of one estimate, over the norm of the gradient: the smaller, the fewer rollouts are needed. "
            "Shaded: the noise covers a jump of the cost."
        ),
        "throw": (
            f"Left, gradient of the cost under noise of {settings.angle_stddev:g} rad; error bars are two standard errors. "
            "Right, weight of the first order in the α-order estimate. Shaded: between the first throws that clear the "
            "wall and the last that do not; there neither derivative sees the jump."
        ),
        "push": (
            f"Components of the gradient by the force at each moment: {settings.num_references} unbiased estimates with a band "
            "of two standard errors, first-order means before it."
        ),
        "hopper": (
            "Components of the policy gradient: rows are the motors, columns what the policy observes, and the offset. "
            "Error bars are two standard errors."
        ),
        "descent": (
            f"Adam from the same start, {settings.num_seeds} seeds, thick their mean. Cost under noise, from the rollouts of "
            "each step; below, weight of the first order."
        ),
    }
