"""C MuJoCo's own step behind the same calls as ours, with derivatives: nothing to compile, any scene that MuJoCo loads."""

from mjxgrad.native.derivative import linearise, roll_out, steer
from mjxgrad.native.engine import INPUTS, engine_of

__all__ = ["INPUTS", "engine_of", "linearise", "roll_out", "steer"]
