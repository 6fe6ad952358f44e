"""The cost and noise of each scene in mjcf/."""

from mjxgrad.tasks.task import Task

__all__ = ["Task"]
