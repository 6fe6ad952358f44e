"""Import JAX and MuJoCo, whose own answer to a wrong variable of the environment is a traceback."""

import importlib
import os
import sys
from pathlib import Path


def _import_jax() -> None:
    """Refuse a value that JAX refuses; a command line ends with the sentence alone.

    Raises:
        ValueError: with the name of the variable.
    """
    try:
        importlib.import_module("jax")
    except ValueError as error:
        told = f"JAX refuses the environment: {error}; JAX's switches are true or false, 1 or 0"
        if Path(sys.argv[0]).name in ("-m", "mjxgrad"):
            print(told, file=sys.stderr)
            sys.exit(2)
        raise ValueError(told) from None


def _import_mujoco() -> None:
    """Import MuJoCo without OpenGL where its choice, MUJOCO_GL, fails; `render` tells of it where OpenGL is needed."""
    try:
        importlib.import_module("mujoco")
    except Exception:  # MuJoCo and PyOpenGL raise errors without a common class
        if (chosen := os.environ.get("MUJOCO_GL")) is None:
            raise
        os.environ["MUJOCO_GL"] = "off"
        try:
            importlib.import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = chosen


_import_jax()
_import_mujoco()
