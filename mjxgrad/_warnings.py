"""C MuJoCo's warnings, which it would write to the terminal and to a file in the current folder; and Ctrl-C while it works.

It has one handler for all threads. A thread that took the handler away while another steps would let that one call nothing.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import TypeVar

import mujoco

_Found = TypeVar("_Found")
STOPPED = threading.Event()
"""Set for a moment after Ctrl-C: what a program calls back should give up."""
_LOCK = threading.Lock()
_LISTENERS: list[tuple[int, deque[str]]] = []  # each with its thread
_FORMER: list = []  # the handler of whoever came before


def give_up_if_stopped() -> None:
    """Raise a KeyboardInterrupt where Ctrl-C has ended what waits for this; work in pieces asks between them."""
    if STOPPED.is_set():
        raise KeyboardInterrupt


def finished(call: Callable[[], _Found]) -> _Found:
    """Return what a call returns, also where Ctrl-C comes while it works: it begins once more.

    It is for the last seconds of a long measurement, which would else be lost with all before.
    """
    try:
        return call()
    except KeyboardInterrupt:
        return call()


@contextlib.contextmanager
def collected() -> Iterator[deque[str]]:
    """Collect the latest warnings of this thread; those of other threads are dropped."""
    told: deque[str] = deque(maxlen=100)
    listener = threading.get_ident(), told
    with _LOCK:
        if not _LISTENERS:
            _FORMER[:] = [mujoco.get_mju_user_warning()]
            mujoco.set_mju_user_warning(_tell)
        _LISTENERS.append(listener)
    try:
        yield told
    finally:
        with _LOCK:
            _LISTENERS[:] = [one for one in _LISTENERS if one is not listener]
            if not _LISTENERS:
                mujoco.set_mju_user_warning(_FORMER.pop())


def _tell(message: str) -> None:
    for thread, told in tuple(_LISTENERS):
        if thread == threading.get_ident():
            told.append(message)
