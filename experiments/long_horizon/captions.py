"""What each figure shows and how to read it."""

from experiments.long_horizon.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    sizes, confidence = outcome.settings.sizes, outcome.settings.confidence
    return {
        "errors": (
            f"Gradient of the mean cost at the horizon by the policy's noisy parameters, from {sizes.num_samples} rollouts. "
            f"Lines: root mean squared error over {sizes.num_repeats} repeats, over the largest gradient of all horizons; bands: "
            f"{confidence:.0%}. Circles: bias, where it is beyond chance. Dashed: horizon from which on zeroth order is as good, "
            "with its interval. Below: variance of one rollout's gradient, summed over parameters."
        ),
        "growth": (
            "Grey: logarithm of the largest singular value of the product of all steps' Jacobians, rollout by rollout; black, "
            "its median. Half the logarithm of the estimate's variance runs along with it. With the pendulum, both are held "
            "against integration with error control: where the steps' distance from it nears one the steps are another motion."
        ),
        "windows": (
            "Gradient of the cost's mean over the whole horizon, when derivatives are cut after a window: plain, and with the "
            "value of what comes after, fitted by a quadratic. Circles: bias beyond chance. "
            "The rightmost window is the whole horizon. "
            "A short window has bias in place of variance."
        ),
    }
