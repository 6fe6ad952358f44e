"""C MuJoCo's warnings, which it would write to the terminal and to a file in the current folder.

It has one handler for all threads. A thread that took the handler away while another steps would let that one call nothing.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Iterator

import mujoco

_LOCK = threading.Lock()
_LISTENERS: list[tuple[int, deque[str]]] = []  # each with its thread
_FORMER: list = []  # the handler of whoever came before


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
