"""Problems and instruments that experiments share and the library does not need: each file is usable alone."""

from pathlib import Path

import gymnasium

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"  # of gymnasium's robots
