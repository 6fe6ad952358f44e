"""Measurements of how far gradients can be trusted."""

from mjxgrad.diagnostics.bias_variance import BiasVariance, Landscape, bias_variance
from mjxgrad.diagnostics.comparison import Comparison, Rollouts, Seconds, compare
from mjxgrad.diagnostics.contacts import contacts_needed
from mjxgrad.diagnostics.horizon import Crossover, Growth, crossover, growth
from mjxgrad.diagnostics.jumps import Jumps, jumps_along
from mjxgrad.diagnostics.slope import SlopeComparison, compare_to_slope, derivative_against_slope, phases
from mjxgrad.diagnostics.soundness import Soundness, UnsoundGradientError, check_soundness, soundness
from mjxgrad.diagnostics.stability import StabilityReport, check_stability
from mjxgrad.diagnostics.statistics import bias_interval, mean_interval, root_mean_square_interval

__all__ = [
    "BiasVariance",
    "Comparison",
    "Crossover",
    "Growth",
    "Jumps",
    "Landscape",
    "Rollouts",
    "Seconds",
    "SlopeComparison",
    "Soundness",
    "StabilityReport",
    "UnsoundGradientError",
    "bias_interval",
    "bias_variance",
    "check_soundness",
    "check_stability",
    "compare",
    "compare_to_slope",
    "contacts_needed",
    "crossover",
    "derivative_against_slope",
    "growth",
    "jumps_along",
    "mean_interval",
    "phases",
    "root_mean_square_interval",
    "soundness",
]
