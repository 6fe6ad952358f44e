"""How a rollout and its derivative turned out, told from numbers that any simulator gives.

The thresholds are coarse on purpose: a class is a kind of behaviour, not an accuracy.
"""

import enum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

UNSOLVED = 1e-3
"""Share of a step's velocity by which a solve may be off."""
GAIN = 0.05
"""Share by which kinetic energy may exceed what there was to draw on."""
AT_REST = 1e-3
"""Share of that energy below which a body has settled."""
BOUNCE = 0.05
"""Error of the restitution, itself between 0 and 1, up to which a bounce is right."""


class Motion(enum.IntEnum):
    """What a rollout did; the larger, the worse. Those from `GAINS_ENERGY` on are failures."""

    SETTLES = 0
    MOVES = 1
    BOUNCES_RIGHT = 2
    BOUNCES_OTHERWISE = 3
    GAINS_ENERGY = 4
    TUNNELS = 5
    UNSOLVED = 6
    DIVERGES = 7

    @property
    def label(self) -> str:
        """In words."""
        others = {Motion.MOVES: "moves on", Motion.UNSOLVED: "not solved"}
        return others.get(self, self.name.lower().replace("_", " "))


class Derivative(enum.IntEnum):
    """What a derivative turned out to be.

    `UNJUDGED` where the truth is not known well enough, `NONE` where the rollout diverged and has no derivative.
    """

    RIGHT = 0
    UNJUDGED = 1
    WRONG = 2
    EXPLODES = 3
    NON_FINITE = 4
    NONE = 5

    @property
    def label(self) -> str:
        """In words."""
        return self.name.lower().replace("_", "-")


class MotionRecord(eqx.Module):
    """What `classify_motion` looks at, one entry per rollout."""

    is_sound: Bool[np.ndarray, " points"]  # whether all states were finite and below the velocity limit
    # Largest share of a step's velocity by which a solve is off, or a bound on it: the share of the forces that it leaves
    # unbalanced.
    residual: Float[np.ndarray, " points"]
    # Largest kinetic energy over what there was to draw on: that of the start, of gravity and of springs compressed at the
    # start.
    gain: Float[np.ndarray, " points"]
    rest: Float[np.ndarray, " points"]  # final kinetic energy over the same
    has_crossed: Bool[np.ndarray, " points"]  # whether bodies ended on the wrong side of each other
    # Speed after a single bounce over that before; NaN without one, or while it lasts.
    restitution: Float[np.ndarray, " points"]
    expected: Float[np.ndarray, " points"]  # the restitution of the motion itself; NaN where it is not known


def classify_motion(record: MotionRecord) -> Int[np.ndarray, " points"]:
    """Say of each rollout what it did, by values of `Motion`; of several failures the worst."""
    knows = np.isfinite(record.restitution) & np.isfinite(record.expected)
    with np.errstate(invalid="ignore"):
        is_right = np.abs(record.restitution - record.expected) <= BOUNCE
    # A comparison with NaN is false, so each question is asked in the form that NaN fails.
    answers = (
        (~record.is_sound, Motion.DIVERGES),
        (~(record.residual <= UNSOLVED), Motion.UNSOLVED),
        (record.has_crossed, Motion.TUNNELS),
        (~(record.gain <= 1 + GAIN), Motion.GAINS_ENERGY),
        (knows & is_right, Motion.BOUNCES_RIGHT),
        (knows, Motion.BOUNCES_OTHERWISE),
        (record.rest <= AT_REST, Motion.SETTLES),
    )
    return np.select([is_so for is_so, _ in answers], [int(kind) for _, kind in answers], int(Motion.MOVES))


def classify_derivative(
    derivative: Float[np.ndarray, " points"],
    is_finite: Bool[np.ndarray, " points"],
    is_sound: Bool[np.ndarray, " points"],
    truth: Float[np.ndarray, " points"],
    truth_error: Float[np.ndarray, " points"],
    *,
    largest: float,
    tolerance: float,
) -> Int[np.ndarray, " points"]:
    """Say of each derivative of one number by one direction, by values of `Derivative`, whether it is right.

    The whole gradient that it was taken from is finite, and its rollout sound, or not. Where the error of the truth exceeds the
    tolerance, a share of the larger of the truth and one, nothing is judged; beyond `largest` a derivative explodes.
    """
    scale = tolerance * np.maximum(np.abs(truth), 1.0)
    with np.errstate(invalid="ignore"):
        answers = (
            (~is_sound, Derivative.NONE),
            (~is_finite | ~np.isfinite(derivative), Derivative.NON_FINITE),
            (np.abs(derivative) > largest, Derivative.EXPLODES),
            (~(truth_error <= scale), Derivative.UNJUDGED),
            (np.abs(derivative - truth) <= scale + truth_error, Derivative.RIGHT),
        )
    return np.select([is_so for is_so, _ in answers], [int(kind) for _, kind in answers], int(Derivative.WRONG))
