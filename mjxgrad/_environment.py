"""JAX and MuJoCo, imported here first: their own answer to a wrong variable of the environment is a traceback."""

import importlib
import os
import sys
from pathlib import Path

try:
    importlib.import_module("jax")
except ValueError as error:
    told = f"JAX refuses the environment: {error}; JAX's switches are true or false, 1 or 0"
    if Path(sys.argv[0]).name not in ("-m", "mjxgrad"):
        raise ValueError(told) from None
    print(told, file=sys.stderr)  # the command line
    sys.exit(2)
try:
    importlib.import_module("mujoco")
except Exception:  # MuJoCo and PyOpenGL raise errors without a common class
    # Where an OpenGL that is chosen fails, MuJoCo is imported without any, and `render` tells of it when it is needed.
    chosen = os.environ.get("MUJOCO_GL", "off")
    os.environ["MUJOCO_GL"] = "off"
    importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = chosen
    # The first attempt's modules are not imported again, and would not be found as attributes.
    for name in [name for name in sys.modules if name.startswith("mujoco.") and name.count(".") == 1]:
        setattr(sys.modules["mujoco"], name.partition(".")[2], sys.modules[name])
