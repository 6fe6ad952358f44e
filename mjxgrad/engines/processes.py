"""Processes that take derivatives of a batch's pieces, where threads would wait for Python's lock.

A process needs MuJoCo and NumPy alone, so that it starts in half a second and imports no JAX. Results are written into shared
memory. Questions go through a pipe, whose end is the end of the process.
"""

import atexit
import contextlib
import functools
import mmap
import os
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjxgrad._interrupts import give_up_if_stopped

# Packages as they are without what they import, which is JAX.
_START = """
import sys, types
for name, place in {packages!r}.items():
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [place]
from mjxgrad.engines.processes import serve
serve()
"""
_CALLBACKS = ("act_bias", "act_dyn", "act_gain", "contactfilter", "control", "passive", "sensor")
_MOST = 8  # pools that a process keeps
_PIECES = 4  # for each process, since some motions cost more than others


@functools.cache
def processes(count: int) -> "Processes":
    """Return so many processes, which are started once."""
    return Processes(count)


def are_started() -> bool:
    """Return whether there are such processes."""
    return processes.cache_info().currsize > 0


def are_possible() -> bool:
    """Return whether other processes step as this one does: no function of this one may be part of a step."""
    is_plain = not any(getattr(mujoco, f"get_mjcb_{name}")() for name in _CALLBACKS)
    return is_plain and os.name == "posix" and bool(sys.executable)


class Processes:
    """Processes that each hold some pools of one thread."""

    def __init__(self, count: int):
        root = Path(__file__).parents[1]
        packages = {"mjxgrad": str(root)}
        packages |= {f"mjxgrad.{name}": str(root / name) for name in ("engines", "scene", "stepping")}
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        places = os.pathsep.join(path for path in sys.path if path)
        start = functools.partial(
            subprocess.Popen,
            [sys.executable, "-P", "-c", _START.format(packages=packages)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | threads | {"PYTHONPATH": places, "MUJOCO_GL": "off"},
            process_group=0,  # an interrupt is for this process, which ends the others
        )
        self.children = [start() for _ in range(count)]
        self.locks = [threading.Lock() for _ in range(count)]
        self.known: list[dict[int, None]] = [{} for _ in range(count)]
        self.threads = ThreadPoolExecutor(count)
        atexit.register(self.close)

    def close(self) -> None:
        """End all processes."""
        for child in self.children:
            with contextlib.suppress(OSError):
                child.stdin.close()  # pyright: ignore
            child.wait()
            child.stdout.close()  # pyright: ignore

    def share(
        self, key: int, model: mujoco.MjModel, count: int, shapes: Mapping[str, tuple[int, ...]], arguments: Any,
        method: str = "write",
    ) -> dict[str, np.ndarray]:  # fmt: skip
        """Return so many rows of these arrays of doubles, whose pieces a method of `Pool` has written.

        A process makes a pool of its own where it does not know the key. `arguments` is a function from a slice to what
        the method takes beside arrays.

        Raises:
            OSError: a process has ended.
        """
        with _memory(shapes) as (path, found):
            size = max(1, -(-count // (_PIECES * len(self.children))))
            pieces = iter([slice(begin, min(begin + size, count)) for begin in range(0, count, size)])

            def work(child: int) -> None:
                for piece in pieces:
                    give_up_if_stopped()
                    self._ask(child, key, model, (path, shapes, piece, method, arguments(piece)))

            list(self.threads.map(work, range(len(self.children))))
        return found

    def _ask(self, child: int, key: int, model: mujoco.MjModel, task: Any) -> None:
        """Let a process do something, and wait for it."""
        pipes = self.children[child]
        assert pipes.stdin is not None
        assert pipes.stdout is not None
        with self.locks[child]:
            new = None
            if key not in self.known[child]:
                new = pickle.dumps(model)
                _remember(self.known[child], key, None)
            try:
                pickle.dump((key, new, task), pipes.stdin, pickle.HIGHEST_PROTOCOL)
                pipes.stdin.flush()
                error = pickle.load(pipes.stdout)
            except (EOFError, pickle.UnpicklingError):  # before or within its answer
                raise BrokenPipeError("a process that takes derivatives has ended") from None
        if error is not None:
            raise error


def serve() -> None:
    """Do what the process at the other end of standard input asks for, until it ends."""
    from mjxgrad.engines.pool import Pool

    asked, told = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed is no answer
    # Where numbers are NaN, MuJoCo would write to the terminal and to a file.
    mujoco.set_mju_user_warning(lambda _: None)
    pools: dict[int, Pool] = {}
    while True:
        try:
            key, model, (path, shapes, piece, method, arguments) = pickle.load(asked)
        except (EOFError, pickle.UnpicklingError):  # whoever asked has ended, perhaps within a question
            return
        error = None
        try:
            if model is not None:
                _remember(pools, key, Pool(pickle.loads(model), num_threads=1))
            with Path(path).open("r+b") as file:
                found = _arrays(mmap.mmap(file.fileno(), 0), shapes)
            getattr(pools[key], method)({name: value[piece] for name, value in found.items()}, *arguments)
        except Exception as problem:
            error = problem
        try:
            pickle.dump(error, told, pickle.HIGHEST_PROTOCOL)
            told.flush()
        except BrokenPipeError:  # whoever asked was killed
            os._exit(0)


def _remember(pools: dict, key: int, value: Any) -> None:
    """Keep what belongs to a pool, for a few of them; both ends of a pipe forget the same."""
    pools[key] = value
    if len(pools) > _MOST:
        del pools[next(iter(pools))]


@contextlib.contextmanager
def _memory(shapes: Mapping[str, tuple[int, ...]]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Give the name of a file that is nowhere on a disk, where that can be, and arrays of zeros in it, which outlive it."""
    size = max(1, sum(8 * int(np.prod(shape)) for shape in shapes.values()))
    with contextlib.ExitStack() as stack:
        if hasattr(os, "memfd_create"):
            number = os.memfd_create("mjxgrad")
            stack.callback(os.close, number)
            path = f"/proc/{os.getpid()}/fd/{number}"
        else:
            file = stack.enter_context(tempfile.NamedTemporaryFile())
            number, path = file.fileno(), file.name
        os.ftruncate(number, size)
        yield path, _arrays(mmap.mmap(number, size), shapes)


def _arrays(memory: mmap.mmap, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    found, place = {}, 0
    for name, shape in shapes.items():
        count = int(np.prod(shape))
        found[name] = np.frombuffer(memory, float, count, place).reshape(shape)
        place += 8 * count
    return found
