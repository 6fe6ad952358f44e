"""What each figure shows and how to read it."""

from experiments.artificial_discontinuity.mating import TILT
from experiments.artificial_discontinuity.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    settings = outcome.settings
    return {
        "forces": (
            f"Force on a body held {1e3 * settings.depth:g} mm deep in a cube, over its largest. Dashed, the gradient of the "
            "volume that both boxes share, scaled alike: it is continuous. Grey lines: places where the force jumps by more "
            f"than {settings.threshold:.0%} of that."
        ),
        "jumps": (
            "A jump is what remains of a change after its interval was divided by millions; force and torque together, over "
            "the largest on the path. Contact that begins gently has an impedance that rises from zero: what still jumps is "
            f"of the geometry. Smoothing is Gaussian, of {1e3 * settings.smoothing:g} mm. Dotted, {settings.threshold:.0%}."
        ),
        "refinement": (
            "Bodies that touch by points, each a spring of its own with an equal share of the stiffness. Each point's force "
            "jumps where its nearest face changes; of a slide along the lattice a whole row does so at once, of one askew "
            "one point after the other. Paths on which some lattice does not jump, or a single point touches, are left out."
        ),
        "slopes": (
            f"The body is let go and pushed for 30 ms; the outcome is its height. Noise on the start of "
            f"{settings.stddev:.1%} of the path, at the place where the box's force jumps. Lines: slopes that "
            f"{settings.sizes.num_samples} rollouts say, and the reference. Right: errors for all bodies, one mark per path."
        ),
        "mating": (
            f"A peg tilted by {TILT:g} rad, in and above a hole that is wider by 3 mm on each side. Points on the peg meet the "
            "boxes of the hole, points on the rim the box of the peg; where only one part has points the other's corners meet "
            "nothing. Grey lines: jumps. That the peg falls through or stays on the rim is real."
        ),
    }
