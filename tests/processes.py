"""Python in a process of its own, for what JAX or an import decides once."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def python(*arguments, **environment):
    """Return the process of Python, on the CPU, when it has ended."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", **environment}
    return subprocess.run([sys.executable, *arguments], env=environment, cwd=ROOT, capture_output=True, text=True)


def run_python(*arguments, **environment):
    """Return what Python wrote to both outputs; an error there fails the test."""
    done = python(*arguments, **environment)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr
