"""The crossing of two errors, from closed forms."""

import numpy as np
import pytest

from mjxgrad.diagnostics import crossover

HORIZONS = np.linspace(1.0, 10.0, 10)


def squared_errors(rng, scale, repeats=200):
    return scale * rng.chisquare(3, size=(repeats, len(HORIZONS))) / 3


def test_the_crossing_of_an_exponential_and_a_constant_is_covered():
    """e^(t − 4.3) and 1 cross at 4.3."""
    rng = np.random.default_rng(0)
    found = crossover(HORIZONS, squared_errors(rng, np.exp(HORIZONS - 4.3)), squared_errors(rng, 1.0))
    assert found.low < 4.3 < found.high
    assert found.high - found.low < 0.5  # √(2 · 2/3/200) of a logarithm, that is 0.08, times 4


def test_the_interval_of_a_crossing_covers_as_often_as_it_says():
    rng, hits = np.random.default_rng(1), 0
    for _ in range(60):
        first, second = squared_errors(rng, np.exp(HORIZONS - 4.3), 40), squared_errors(rng, 1.0, 40)
        found = crossover(HORIZONS, first, second, num_resamples=100)
        hits += found.low <= 4.3 <= found.high
    assert 51 <= hits <= 60  # 57 give or take three and a half standard deviations of a binomial


def test_what_does_not_cross_is_infinite_or_the_beginning():
    ones = np.ones((4, len(HORIZONS)))
    assert crossover(HORIZONS, ones, 2 * ones).horizon == np.inf
    assert crossover(HORIZONS, ones, 2 * ones).high == np.inf
    assert crossover(HORIZONS, 2 * ones, ones).horizon == 1.0


def test_a_passing_draw_is_no_crossing():
    ratio = np.where(HORIZONS == 2, 1.5, np.exp(HORIZONS - 6.5))
    first, second = np.broadcast_to(ratio, (4, 10)), np.ones((4, 10))
    assert crossover(HORIZONS, first, second).horizon == pytest.approx(6.5)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((HORIZONS[::-1].copy(), np.ones((4, 10)), np.ones((4, 10))), "horizons must increase"),
        ((HORIZONS[1:], np.ones((1, 9)), np.ones((1, 9))), "at least two repeats"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        crossover(*arguments)
