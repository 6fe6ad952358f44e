"""Measurements of how far gradients can be trusted."""

from mjxgrad.diagnostics.bias_variance import BiasVariance, Landscape, bias_variance
from mjxgrad.diagnostics.jumps import Jumps, jumps_along
from mjxgrad.diagnostics.slope import SlopeComparison, compare_to_slope, phases
from mjxgrad.diagnostics.stability import StabilityReport, check_stability
from mjxgrad.diagnostics.statistics import mean_interval

__all__ = [
    "BiasVariance",
    "Jumps",
    "Landscape",
    "SlopeComparison",
    "StabilityReport",
    "bias_variance",
    "check_stability",
    "compare_to_slope",
    "jumps_along",
    "mean_interval",
    "phases",
]
