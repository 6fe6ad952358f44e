"""Jumps of force that come from the geometry of contact and not from the motion."""
