"""Ctrl-C: what waits for C++ ends within a second, and no interruption is lost."""

import _thread
import atexit
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from types import FrameType
from typing import Any, TypeVar

_Found = TypeVar("_Found")
STOPPED = threading.Event()
"""Set for a moment after Ctrl-C: what a program calls back should give up."""
COMES_AGAIN = threading.Event()
"""Set while an interruption is on its way that Python had lost."""
_SOON = 0.05  # s
_NOW = 2e-5  # s
# Where JAX is called by XLA, and by garbage collection, in which Python ignores exceptions.
_CALLED_BACK = ("jax/_src/callback.py", "jax/_src/lib/__init__.py")

# JAX would print a traceback for each callback that gives up.
logging.getLogger("jax._src.callback").addFilter(lambda _: not STOPPED.is_set())


def wait_for_programs() -> None:
    """Deliver Ctrl-C after a compiled program, and not within a function that it calls back: XLA would make another error of it.

    So one's own loop ends with a KeyboardInterrupt, and no step is lost. A second Ctrl-C is delivered at once.
    """
    again = getattr(signal, "SIGVTALRM", None)  # which hardly any program uses, and Windows lacks
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or again is None or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    is_waiting = False

    def deliver(number: int, frame: FrameType | None) -> None:
        nonlocal is_waiting
        if number == again and not is_waiting:
            return
        was_waiting, is_first = is_waiting, number == again or not is_waiting
        is_waiting = is_first and _is_called_back(frame)
        if not is_waiting:
            raise KeyboardInterrupt
        if not was_waiting:
            threading.Thread(target=deliver_again, daemon=True).start()

    def deliver_again() -> None:
        # Also while a program of C++ runs: what is pending when it ends comes before the next line of Python.
        former = sys.getswitchinterval()
        sys.setswitchinterval(_NOW)  # or between two programs of a loop this would find no time
        while is_waiting:
            time.sleep(_NOW)
            _thread.interrupt_main(again)
        sys.setswitchinterval(former)

    signal.signal(again, deliver)
    signal.signal(signal.SIGINT, deliver)


def _is_called_back(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.replace(os.sep, "/").endswith(_CALLED_BACK):
            return True
        frame = frame.f_back
    return False


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
