"""Optimisation of the published tasks by several methods, at equal rollouts."""
