"""The first import of JAX and MuJoCo, where a wrong variable or Ctrl-C ends in a sentence; the only one of MJX.

An import takes seconds, and C++ that runs meanwhile swallows a KeyboardInterrupt at times. So Ctrl-C ends a command at once,
which has nothing to keep yet; in a program it is raised, and again where it was lost, once the import is done.

`mujoco.mjx` prints two lines to stdout if NVIDIA Warp is absent, which this library does not use.
A library must not print, and stdout may carry a program's results. Only those two lines are
dropped; other output of the import is passed on.
"""

# ruff: noqa: F401
import contextlib
import importlib.metadata
import io
import os
import signal
import sys
import threading
from pathlib import Path

_BEGAN = [os.path.basename(word) for word in sys.orig_argv[1:3]]  # noqa: PTH119 - as text, for the import is not done
IS_COMMAND = _BEGAN[:1] == ["mjxgrad"] or _BEGAN == ["-m", "mjxgrad"]
_heard: list[int] = []


def _hear(number: int, frame: object) -> None:
    if IS_COMMAND:
        os.write(2, b"interrupted\n")
        os._exit(130)
    _heard.append(number)
    raise KeyboardInterrupt


def imported() -> None:
    """Give Ctrl-C back to the program once all is imported, and raise what was lost."""
    if signal.getsignal(signal.SIGINT) is not _hear or IS_COMMAND:  # the command has a handler of its own, later
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if _heard:
        raise KeyboardInterrupt


if (
    threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
):
    signal.signal(signal.SIGINT, _hear)

# A file beside the program that has a library's name is imported in its place, and fails far from the cause.
for _name in ("numpy", "jax", "mujoco", "equinox", "optax"):
    if (_file := Path(sys.path[0], f"{_name}.py")).is_file():
        raise ImportError(f"{_file} hides the library {_name}: rename it")

try:
    importlib.import_module("jax")
except ValueError as error:
    _told = f"JAX refuses the environment: {error}; JAX's switches are true or false, 1 or 0"
    if not IS_COMMAND:
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
    # By `print`, for a closed stdout is None.
    print(*(line for line in _said.getvalue().splitlines(keepends=True) if not line.startswith(_NOISE)), sep="", end="")

MJX_VERSION = importlib.metadata.version("mujoco-mjx")
