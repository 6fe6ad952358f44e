"""Where a scene is stable, and how a rollout and its gradient fail where it is not."""

from mjxgrad.diagnostics.stability.check import check_stability
from mjxgrad.diagnostics.stability.classes import (
    UNSOLVED,
    Derivative,
    Motion,
    MotionRecord,
    classify_derivative,
    classify_motion,
)
from mjxgrad.diagnostics.stability.report import StabilityReport
from mjxgrad.diagnostics.stability.soundness import Soundness, UnsoundGradientError, check_soundness, soundness
from mjxgrad.diagnostics.stability.spring import Spring

__all__ = [
    "UNSOLVED",
    "Derivative",
    "Motion",
    "MotionRecord",
    "Soundness",
    "Spring",
    "StabilityReport",
    "UnsoundGradientError",
    "check_soundness",
    "check_stability",
    "classify_derivative",
    "classify_motion",
    "soundness",
]
