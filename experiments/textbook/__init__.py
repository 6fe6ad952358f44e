"""Estimators on costs whose smoothed gradient is known in closed form."""
