"""What the figures of an experiment on smoothing kernels show."""

from experiments.kernels.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the caption of each figure, by name."""
    settings = outcome.settings
    return {
        "profiles": (
            "Static force of a contact against distance, in units of its slope deep inside and of the length of the noise, "
            f"{1e3 * settings.length:g} mm; in the middle on a logarithmic scale. Right, the second derivative of the same "
            "curves over their slope: the density of the noise that they are the mean over, where there is one. A margin is a "
            "shift (a point mass, drawn as a line). MuJoCo's rising impedance is negative somewhere, and so no density."
        ),
        "motion": (
            f"A ball thrown at a plane with {settings.speed:g} m/s. Lines: one rollout of the smoothed solver. Dots: mean "
            f"over {settings.num_rollouts} rollouts of MuJoCo's own contact whose distance is shifted by other noise in each "
            "step, with bars of two standard errors. Right, the derivative: lines by automatic differentiation of the "
            "smoothed rollout, dots by differences of the sampled mean. Dashed, MuJoCo's contact without noise and the exact "
            "derivative of its simulated map, which does not see that the time of impact moves."
        ),
    }
