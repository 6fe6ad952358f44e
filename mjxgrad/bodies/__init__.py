"""Rigid bodies: joint trees, orientations, inertia, forces, tendons and actuators; the unconstrained part of a step."""

from mjxgrad.bodies.constants import set_const
