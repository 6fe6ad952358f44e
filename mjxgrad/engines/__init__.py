"""Who steps a scene: C MuJoCo behind the same calls as MJX, with derivatives: nothing to compile, any scene that MuJoCo loads."""

from mjxgrad.engines.layout import INPUTS, MOTION
from mjxgrad.engines.mujoco import engine_of
from mjxgrad.engines.rule import linearise, product, roll_out, sense, steer, to_coordinates

__all__ = ["INPUTS", "MOTION", "engine_of", "linearise", "product", "roll_out", "sense", "steer", "to_coordinates"]
