"""What to do with a scene of one's own: `check` it, and read the verdict."""

from mjxgrad.verdict.check import Verdict, check
from mjxgrad.verdict.findings import Finding, Recommendation

__all__ = ["Finding", "Recommendation", "Verdict", "check"]
