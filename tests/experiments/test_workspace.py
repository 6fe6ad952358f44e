"""Work in threads keeps its order, tells how far it is, and does not hide what went wrong."""

import threading

import pytest

from experiments.workspace import in_threads, num_compilers


def test_results_keep_the_order_of_the_items():
    """Even where the first item is done last."""
    if num_compilers() < 2:
        pytest.skip("one core, one thread")
    second_is_done, told = threading.Event(), []

    def work(item):
        if item == 0:
            assert second_is_done.wait(timeout=10)
        if item == 1:
            second_is_done.set()
        return item * item

    assert in_threads(work, range(5), told.append) == [0, 1, 4, 9, 16]
    assert told == [1, 2, 3, 4, 5]


def test_the_first_mistake_is_raised():
    def work(item):
        if item == 2:
            raise ValueError("no such scene")
        return item

    with pytest.raises(ValueError, match="no such scene"):
        in_threads(work, range(4))
