"""Jumps along a path: told from slopes, with the right place and size, and none left out in silence."""

import numpy as np
import pytest

from mjxgrad.diagnostics import jumps_along

RESOLUTION = 2 / 255 / 17**6  # of a path of length 2: 256 points, each interval in 17 parts six times


def test_a_step_on_a_slope_has_its_place_and_its_size():
    found = jumps_along(lambda x: 3 * x + 0.7 * (x > 0.3), (-1.0, 1.0))
    assert found.places == pytest.approx([0.3], abs=RESOLUTION)
    assert found.sizes == pytest.approx([0.7], abs=4 * RESOLUTION)  # the slope within the last interval


def test_every_step_of_a_stair_is_found_once():
    found = jumps_along(lambda x: np.floor(5 * x), (0.05, 2.05))
    assert found.places == pytest.approx(np.arange(1, 11) / 5, abs=RESOLUTION)


@pytest.mark.parametrize("function", [lambda x: np.tanh(1e5 * (x - 0.3)), lambda x: np.sqrt(np.abs(x - 0.3))])
def test_what_is_steep_is_no_jump(function):
    found = jumps_along(function, (-1.0, 1.0))
    assert len(found.places) == 0
    assert found.largest == -1


def test_a_slope_is_no_jump_however_few_the_rounds():
    """After one division of 17 parts it still changes by 3 % of the largest value, but has shrunk."""
    assert len(jumps_along(lambda x: np.tanh(100 * (x - 0.3)), (-1.0, 1.0), num_refinements=1).places) == 0


def test_of_more_jumps_than_candidates_the_largest_remain():
    steps = jumps_along(
        lambda x: (x > 0.2) + 3.0 * (x > 0.5) + 2.0 * (x > 0.7), (0.0, 1.0), num_points=64, num_candidates=2
    )
    assert steps.sizes == pytest.approx([3, 2])
    assert steps.places[steps.largest] == pytest.approx(0.5)


def test_beside_what_is_not_finite_no_jump_is_claimed():
    found = jumps_along(lambda x: np.where(x > 0.5, np.nan, 1.0 * (x > 0.25)), (0.0, 1.0))
    assert found.places == pytest.approx([0.25])
