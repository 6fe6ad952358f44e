"""What each figure shows and how to read it."""

from experiments.textbook.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    settings = outcome.settings
    percent = f"{settings.confidence:.0%}"
    repeats = f"Each mark is from {settings.num_repeats} estimates, with its {percent} interval"
    shown = "" if settings.shown_stiffness is None else f" at stiffness {settings.shown_stiffness:g}"
    return {
        "problem": (
            f"Left, the cost{shown}; right, the gradient that is to be estimated, and what first order converges to. "
            "Where the two part, first order is biased. The dotted line marks the point of the estimates below."
        ),
        "samples": (
            f"{repeats}. Left, distance to the true gradient; thin lines are closed forms, dotted ones join marks that "
            "have none. Right, mean less truth; at −1 (dotted) an estimate is zero throughout. A budget counts every "
            "rollout, that without noise included. Intervals that leave the panel are cut."
        ),
        "stiffness": (
            f"{repeats}, {settings.samples_at_stiffness} rollouts each. Left, distance to the true gradient; thin lines "
            "are closed forms. Right, variance of the estimate times rollouts. An estimate that never varies, because "
            "all its samples miss, has no mark there."
        ),
        "missing": (
            "Left, for each stiffness: line, the closed form (1 − β)ᴺ; dots, how often N simulated samples all missed; "
            f"diamonds, what {settings.missed_samples} first-order samples tell, with its {percent} interval. Right, the "
            "variance of a sample of first order, as the same samples show it, and the least that the discrepancy between "
            "them and the gradient implies; shaded where no sample hit the slope, so that they show none."
        ),
    }
