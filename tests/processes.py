"""Python in a process of its own, for what JAX or an import decides once."""

import os
import subprocess
import sys
import time
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


def once(folder, name, write):
    """Return the text that a function writes, which one of the processes that share a folder calls."""
    path, part = folder / name, folder / f"{name}.part"
    try:
        part.touch(exist_ok=False)
    except FileExistsError:
        while not path.exists():
            time.sleep(0.1)
    else:
        try:
            part.write_text(write())
        finally:
            part.rename(path)
    return path.read_text()
