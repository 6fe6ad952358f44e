"""What stands below the pictures."""

from experiments.work_precision.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the figure's name; later scenes have short ones.
    """
    settings, sizes = outcome.settings, outcome.settings.sizes
    return {
        "motion": (
            f"Error of the state after the motion's whole time, root mean square over {sizes.batch} starts, against wall time "
            "per simulated second and state, those starts simulated in one batch. Error: the larger of the distance of positions "
            "(mj_differentiatePos, in m and rad, Euclidean) over the way gone and that of velocities over the speed. Along a "
            "line the time step gets smaller to the right; bars are the range over repetitions. Left: the solver run to "
            f"{settings.tight_tolerance:g} (float32: 1e-6), the scene's own cone; the broad grey line is what no "
            "other beats, rings what no other on JAX does. "
            "Right: loose tolerances at the two coarsest steps, few iterations, and the other cone, compared with its own "
            "reference. Dotted: how far the reference itself moved when its step was last halved; below it nothing is "
            "known; it is left out where it is far below all errors. "
            "Grey: the errors that settings are recommended for. Compilation is apart, in the table."
        ),
        "motion_next": "As above.",
        "gradient": (
            "Error of a gradient estimate, root mean square over 64 repetitions of its distance to the reference over the "
            "reference's norm, against the wall time of its rollouts (left) and their number (right). Two velocities of the "
            "start are the parameters, Gaussian noise on them smooths the outcome, a weighted sum of final positions. Thick: the "
            "scene's own time step and contact, bars from the lower to the upper quartile; thin: other steps and softer "
            "contacts, whose error against the true scene levels off at their bias. Zeroth order takes more rollouts with "
            "more parameters; these are two. Derivatives are taken forward, as the library does for up to three."
        ),
        "gradient_next": "As above.",
    }
