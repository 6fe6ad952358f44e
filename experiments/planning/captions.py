"""What each figure shows and how to read it."""

from experiments.planning.outcome import Outcome


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the plans, for what they were made with.

    Returns:
        By the figure's name.
    """
    plane = (
        "Rod and finger every 0.3 s and at the end, from light to dark; the dashed outline is the goal, the ring where the "
        "finger starts."
    )
    settings = outcome.settings
    return {
        "cost": (
            "Left, the cost of the scene itself under the controls of each iteration (thick), and of the smoothed scene that the "
            "iteration works on (thin). Right, the smoothing length. Both costs meet as the smoothing vanishes; a cost that "
            "rises on the way is a plan whose contact existed in the smoothed scene alone. The best controls of all are kept."
        ),
        "plane": plane,
        "pose": "The rod under the plan that was kept, every decision; dashed, the goal.",
        "tree": (
            "Left, where the rod is in every node, joined to its parent; thick, the way that was found. Right, the nearest that "
            "the tree has come to the goal, in units of the tolerance, against its nodes, for "
            f"{settings.tree.num_seeds} seeds of each kind of linear model; below the dotted line it is solved."
        ),
    }
