"""Rigid bodies: trees of joints, turns, masses and forces, with tendons and actuators; all of a step that is no constraint."""

from mjxgrad.bodies.constants import set_const

__all__ = ["set_const"]
