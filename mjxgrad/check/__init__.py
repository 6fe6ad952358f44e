"""What to do with a scene of one's own: `check` it, `sweep` its contact, and read what they say."""

from mjxgrad.check.check import Verdict, check
from mjxgrad.check.findings import Finding, Recommendation
from mjxgrad.check.sweep import Sweep, sweep

__all__ = ["Finding", "Recommendation", "Sweep", "Verdict", "check", "sweep"]
