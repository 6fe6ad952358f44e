"""Derivatives of motions with several impacts against the slope of the simulated motion."""
