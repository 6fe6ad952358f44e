"""Smoothing kernels: barrier and density side by side, and the smoothed step against sampled noise."""
