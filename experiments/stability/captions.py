"""What each figure shows and how to read it."""

from experiments.stability.classes import BOUNCE, GAIN
from experiments.stability.outcome import Outcome, SceneOutcome

_LIMITS = {
    "two balls": "Dashed, against the speed: one step, or one bounce, carries a ball past the other's centre. ",
    "chain": "Dashed, the explicit limit of a joint limit, h²k + 2hb = 4. ",
}
_EXPLICIT = (
    "Dashed, the explicit limit h²k + 2hb = 4, in the standard format h/t_c = 2ζ(√(1 + ζ²) − ζ): above or to the unstable "
    "side of it a single contact gains energy. "
)


def captions(outcome: Outcome) -> dict[str, str]:
    """Write the captions.

    Args:
        outcome: the numbers, for what they were made with.

    Returns:
        By the name of the scene.
    """
    return {one.scene.name: _caption(one, outcome) for one in outcome.scenes}


def _caption(one: SceneOutcome, outcome: Outcome) -> str:
    return (
        f"Each square is one rollout of {outcome.settings.num_steps} steps, whatever the time step, and its gradient; all that "
        f"is not on an axis is MuJoCo's default. {_LIMITS.get(one.scene.family, _EXPLICIT)}A bounce is right within {BOUNCE:g} "
        f"of its restitution; energy is gained beyond {GAIN:.0%}. Gradients are judged by central differences in float64; where "
        "the motion diverges there is none."
    )
