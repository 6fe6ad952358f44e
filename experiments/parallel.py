"""Several programs at once, in threads: XLA compiles each mostly on one core and without Python."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Item, _Result = TypeVar("_Item"), TypeVar("_Result")

# Programs that are compiled side by side, at most: the largest take a gigabyte each.
_MOST = 8


def num_cores() -> int:
    """Count the cores that this process may use."""
    has_affinity = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1


def num_compilers() -> int:
    """Say how many programs to compile side by side: one per core, as many as memory has room for."""
    return min(num_cores(), _MOST)


def in_threads(
    function: Callable[[_Item], _Result], items: Iterable[_Item], advance_to: Callable[[int], None] = lambda _: None
) -> list[_Result]:
    """Call a function that compiles on every item; results keep the order, and `advance_to` is told how many there are."""
    done = []
    with ThreadPoolExecutor(num_compilers()) as pool:
        for result in pool.map(function, items):
            done.append(result)
            advance_to(len(done))
    return done
