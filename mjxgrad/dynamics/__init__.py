"""One step that can be differentiated."""

from mjxgrad.dynamics.step import forward, solve, step

__all__ = ["forward", "solve", "step"]
