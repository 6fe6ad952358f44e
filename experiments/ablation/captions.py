"""What the figure shows and how to read it."""

from experiments.ablation.outcome import Outcome
from experiments.parallel import num_compilers


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    sizes = outcome.settings.sizes
    return {
        "ratios": (
            "Each as a share of the same scene with everything; left of the line is cheaper. Dots are medians of "
            f"{sizes.repeats} turns, bars their quartiles; compilation is that of the gradient, once, without a cache, "
            f"{num_compilers(besides=1)} at a time while others are traced. Only "
            "variants that make another program are drawn: all others are the scene with everything, letter for letter. Open "
            "dots: motion or gradient is another one. "
            f"{sizes.batch} rollouts of {sizes.horizon} steps, started along recorded motions."
        )
    }
