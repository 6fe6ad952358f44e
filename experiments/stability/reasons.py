"""Why mjxgrad does worse than C MuJoCo on a point, told from the numbers of that point."""

import numpy as np

from experiments.stability.classes import Derivative, Motion
from experiments.stability.limits import load
from experiments.stability.outcome import C_MUJOCO, SceneOutcome

UNEXPLAINED = "unexplained"
_SAME_MOTION = 1e-3
"""Difference of final positions, over what a body flies in the rollout, up to which two motions are one."""
_LITTLE_FRICTION = 0.03
"""Below it the edges of a pyramid weigh more than a thousand times what its normal would."""


def reasons(one: SceneOutcome, precision: str) -> dict[int, str]:
    """Give the reason of every point at which mjxgrad does worse.

    Args:
        one: a scene.
        precision: of mjxgrad.

    Returns:
        By index of the point; `UNEXPLAINED` where no reason is found.
    """
    values, ours, theirs = one.points.values, one.behaviour[precision], one.behaviour[C_MUJOCO]
    is_fine_in_double = ~one.worse("float64")
    takes_other_impedance = (values["width"] == 0) & (values["impedance_first"] != values["impedance_last"])
    is_unsolved = ours.motion == Motion.UNSOLVED
    is_single = is_fine_in_double & (precision == "float32")
    has_steep_pyramids = one.scene.name.endswith("pyramidal") & (values["friction"] < _LITTLE_FRICTION)
    # Of balls, two radii deep.
    coincide = bool(one.scene.crossing) & (values["depth"] == 2)
    rules = (
        (is_unsolved & is_single & has_steep_pyramids, "pyramids of little friction weigh as 1/μ²: beyond float32"),
        (is_unsolved & is_single, "the solve stops short, in float32 alone"),
        (is_unsolved, "the solve stops short"),
        (takes_other_impedance, "width 0: C MuJoCo takes the mean of both impedances, MJX the second"),
        (one.apart[precision] <= _SAME_MOTION, "the same motion, on either side of the bound between two classes"),
        (coincide, "the centres coincide: rounding decides on which side they part"),
        (is_single, "single precision: right in float64"),
        (theirs.motion >= Motion.GAINS_ENERGY, "C MuJoCo fails, too, in another way"),
        (load(one.scene, one.points) >= 1, "beyond the explicit limit, where rounding grows"),
        (theirs.derivative == Derivative.EXPLODES, "the derivative of C MuJoCo's motion explodes: rounding grows"),
    )
    conditions, names = zip(*rules, strict=True)
    chosen = np.select(list(conditions), list(range(len(names))), len(names))
    return {int(i): (*names, UNEXPLAINED)[chosen[i]] for i in np.flatnonzero(one.worse(precision))}
