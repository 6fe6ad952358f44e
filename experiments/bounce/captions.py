"""What each figure shows and how to read it."""

from experiments.bounce.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name.
    """
    settings = outcome.settings
    return {
        "derivative": (
            f"Derivative of the height after {settings.duration:g} s with respect to the start height, mean over "
            f"{settings.num_phases} start heights; bars are the standard deviation over them, the phases of the time step. The "
            "truth is less the restitution, by quadrature of the contact's own equation. Finite differences span what the "
            "ball flies in one step; far shorter ones give the discrete gradient. The axis is linear between −0.1 and 0.1."
        ),
        "error": (
            "Error of the derivative with contact that begins within the step, as a share of the slope, one "
            "square per contact. A dot: beyond the tolerance, but not beyond two standard errors of the means. Crossed squares "
            "are not judged: the step is unstable there, or the slope is not known well enough."
        ),
        "steps": (
            "The same errors, of all three, against the number of time steps that the contact lasts: one dot per contact "
            f"and time step. Dotted, {settings.tolerance:.0%}. Errors larger than the slope lie at 100%, those below 10⁻⁴ there."
        ),
    }
