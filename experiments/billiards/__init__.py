"""Optimal control of a stroke from balls that do not touch, by several methods."""
