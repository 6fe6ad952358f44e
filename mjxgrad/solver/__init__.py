"""Constraint forces, as the minimum of a convex cost: laws and Jacobians of rows, Newton's method, its derivative."""
