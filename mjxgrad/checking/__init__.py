"""Advice for a scene of one's own: `check` it, `sweep` its contact softness, and read the reports."""

from mjxgrad.checking.check import Verdict, check
from mjxgrad.checking.costs import named_cost
from mjxgrad.checking.findings import Finding, Recommendation
from mjxgrad.checking.sweep import Sweep, sweep

__all__ = ["Finding", "Recommendation", "Sweep", "Verdict", "check", "named_cost", "sweep"]
