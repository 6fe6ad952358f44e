"""How far gradients can be trusted, measured."""

from mjxgrad.diagnostics.bias_variance import BiasVariance, bias_variance
from mjxgrad.diagnostics.reference import Landscape
from mjxgrad.diagnostics.statistics import (
    bootstrap_variance_interval,
    chi_square_variance_interval,
    mean_interval,
)

__all__ = [
    "BiasVariance",
    "Landscape",
    "bias_variance",
    "bootstrap_variance_interval",
    "chi_square_variance_interval",
    "mean_interval",
]
