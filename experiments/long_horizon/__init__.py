"""Estimates of both orders against the horizon, with and without contact, and windows that cut it."""
