"""Ctrl-C: what waits for C++ ends within a second, and no interruption is lost."""

import atexit
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

_Found = TypeVar("_Found")
STOPPED = threading.Event()
"""Set for a moment after Ctrl-C: what a program calls back should give up."""
COMES_AGAIN = threading.Event()
"""Set while an interruption is on its way that Python had lost."""
_SOON = 0.05  # s

# JAX would print a traceback for each callback that gives up.
logging.getLogger("jax._src.callback").addFilter(lambda _: not STOPPED.is_set())


def lose_none() -> None:
    """Deliver Ctrl-C again where Python ignores it, as in functions that garbage collection calls, of which JAX has one."""
    former = sys.unraisablehook

    def hook(ignored: Any) -> None:
        if ignored.exc_type is not KeyboardInterrupt:
            former(ignored)
            return
        COMES_AGAIN.set()
        timer = threading.Timer(_SOON, os.kill, (os.getpid(), signal.SIGINT))
        timer.daemon = True
        timer.start()

    sys.unraisablehook = hook


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


def patiently(call: Callable[[], Any]) -> Any:
    """Return what a call returns, in another thread, so that Ctrl-C ends the wait while a program of C++ runs on.

    The call has most of a second to end; Python functions that it calls give up at once.
    """
    import jax  # which processes that take derivatives do without

    if threading.current_thread() is not threading.main_thread():
        return call()
    found, is_double = Future(), jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]

    def work() -> None:
        try:
            with jax.enable_x64(is_double):  # a thread does not see settings made by `with`
                found.set_result(call())
        except BaseException as error:
            found.set_exception(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        return found.result()
    except KeyboardInterrupt:
        STOPPED.set()
        thread.join(0.7)
        STOPPED.clear()
        atexit.register(_leave, thread)
        raise


def _leave(thread: threading.Thread) -> None:
    """End the process where C++ goes on in an abandoned thread, which Python would wait for or tear out with a crash."""
    atexit.unregister(_leave)
    if thread.is_alive():
        atexit._run_exitfuncs()
        sys.stdout.flush()
        os._exit(130)
