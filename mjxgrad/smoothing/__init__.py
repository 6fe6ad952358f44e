"""Contact averaged over noise on its distance, in closed form, within the solver.

The dynamics build on what is exported here. What builds on the dynamics in turn, `probe` and `linear_model`, are
modules to import by name.
"""

from mjxgrad.smoothing.kernels import KERNELS, Gaussian, Kernel, LogBarrier, Logistic
from mjxgrad.smoothing.smoothing import KernelName, Mode, Smoothing, smoothing_warnings

__all__ = [
    "KERNELS",
    "Gaussian",
    "Kernel",
    "KernelName",
    "LogBarrier",
    "Logistic",
    "Mode",
    "Smoothing",
    "smoothing_warnings",
]
