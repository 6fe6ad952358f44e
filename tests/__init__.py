"""Types are checked in the first calls of each function alone: more of them took a tenth of all tests' time."""

import contextlib
import functools
import inspect
import operator
import sys

from beartype import beartype

_CALLS = 20


def sparing(function):
    """Check a signature as beartype does, and let jaxtyping call the function of that name directly from some call on."""
    checked, num_calls = beartype(function), 0

    @functools.wraps(function)
    def check(*args, **kwargs):
        nonlocal num_calls
        num_calls += 1
        if num_calls == _CALLS:
            _leave_unchecked(function.__module__, function.__qualname__)
        return checked(*args, **kwargs)

    return check


def _leave_unchecked(module, qualname):
    with contextlib.suppress(AttributeError, KeyError):  # a function within another is found nowhere and stays checked
        found = operator.attrgetter(qualname)(sys.modules[module])
        inspect.unwrap(getattr(found, "fget", found)).__no_type_check__ = True
