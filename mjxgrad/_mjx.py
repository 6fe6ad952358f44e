"""The first import of JAX and MuJoCo, where a wrong variable of the environment ends in a sentence; the only one of MJX.

`mujoco.mjx` prints two lines to stdout if NVIDIA Warp is absent, which this library does not use.
A library must not print, and stdout may carry a program's results. Only those two lines are
dropped; other output of the import is passed on.
"""

# ruff: noqa: F401
import contextlib
import importlib.metadata
import io
import os
import sys

try:
    importlib.import_module("jax")
except ValueError as error:
    _told = f"JAX refuses the environment: {error}; JAX's switches are true or false, 1 or 0"
    if not sys.argv[0].endswith(("-m", "mjxgrad")):
        raise ValueError(_told) from None
    print(_told, file=sys.stderr)  # the command line
    sys.exit(2)
try:
    importlib.import_module("mujoco")
except Exception:  # MuJoCo and PyOpenGL raise errors without a common class
    # Where an OpenGL that is chosen fails, MuJoCo is imported without any, and `render` tells of it when it is needed.
    _chosen, os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL", "off"), "off"
    importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = _chosen
    # The first attempt's modules are not imported again, and would not be found as attributes.
    for _name in [name for name in sys.modules if name.startswith("mujoco.") and name.count(".") == 1]:
        setattr(sys.modules["mujoco"], _name.partition(".")[2], sys.modules[_name])

_NOISE = ("Failed to import warp:", "Failed to import mujoco_warp:")

_said = io.StringIO()
try:
    with contextlib.redirect_stdout(_said):
        from mujoco import mjx

        # Private functions that decide which geoms MJX tests for contact, and the sizes of its data: a second
        # implementation of these rules could disagree.
        from mujoco.mjx._src.collision_driver import _COLLISION_FUNC as COLLISION_FUNCTIONS
        from mujoco.mjx._src.collision_driver import _contact_groups as contact_groups
        from mujoco.mjx._src.collision_driver import _geom_groups as geom_groups
        from mujoco.mjx._src.collision_driver import _numeric as custom_number
        from mujoco.mjx._src.collision_driver import geom_pairs, has_collision_fn
        from mujoco.mjx._src.constraint import counts, make_efc_address, make_efc_type
        from mujoco.mjx._src.math import make_frame
        from mujoco.mjx._src.passive import _fluid as fluid_force
        from mujoco.mjx._src.passive import _gravcomp as compensate_gravity
except AttributeError as error:
    if (other := sys.modules.get("warp")) is None:
        raise
    raise ImportError(
        f"MuJoCo's MJX takes {next(iter(getattr(other, '__path__', ['warp.py'])))} for NVIDIA Warp: rename it ({error})"
    ) from None
finally:
    sys.stdout.writelines(line for line in _said.getvalue().splitlines(keepends=True) if not line.startswith(_NOISE))

MJX_VERSION = importlib.metadata.version("mujoco-mjx")
