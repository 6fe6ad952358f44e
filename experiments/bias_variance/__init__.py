"""Bias and variance of first- and zeroth-order gradients against contact stiffness."""
