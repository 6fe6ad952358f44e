"""Pairs of motions: when the derivative along the motion takes over, and what becomes of them where slots lack."""

import mujoco
import numpy as np

from mjxgrad.engines.mujoco import PAIRS, _through
from mjxgrad.native.pairs import Pair, settle

MODEL = mujoco.MjModel.from_xml_string("<mujoco/>")


def _pair(place, apart, felt=(1.0, 0.0)):
    return Pair(MODEL, [], 2.0, np.array(felt), np.ones(2), list(map(np.array, apart)), place)


def test_a_pair_is_over_once_three_steps_in_a_row_are_explained_to_a_twentieth():
    """Two steps that are off by more begin the count anew."""
    pair, counts = _pair((0, 0), [[1.0, 0.0]]), []
    for factor in (1.0, 1.03, 2.0, 1.0, 1.0, 0.94, 1.0, 0.97, 1.0):
        assert not pair.is_over
        found = 0.5 * pair.apart[-1]
        assert pair.go_on([], pair.distance * found, factor * found)
        counts.append(pair.num_alike)
    assert counts == [1, 2, 0, 1, 2, 0, 1, 2, 3]
    assert pair.is_over
    assert not pair.go_on([], np.array([np.nan, 0.0]), np.zeros(2))
    assert len(pair.apart) == 10


def test_a_pair_that_is_explained_goes_on_while_it_is_far_apart():
    """Eleven times as far as at first; then nine times."""
    pair = _pair((0, 0), [[11.0, 0.0]])
    for factor in (1.0, 1.0, 1.0, 9 / 11):
        assert not pair.is_over
        found = factor * pair.apart[-1]
        assert pair.go_on([], pair.distance * found, found)
    assert pair.is_over


def test_a_pair_whose_derivative_never_explains_it_is_let_go():
    pair, num_steps = _pair((0, 0), [[1.0, 0.0]]), 1
    while not pair.is_over:
        pair.go_on([], pair.apart[-1], np.zeros(2))
        num_steps += 1
    assert num_steps == 100


def test_what_pairs_add_is_the_sum_of_their_differences():
    """Of three that overlap two have a slot, so the first, less apart, ends where the third begins, and is carried on."""
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(6, 1, 2, 2))
    pairs = [_pair((0, k), (0.01 if k == 0 else 1.0) * rng.normal(size=(4, 2)), rng.normal(size=2)) for k in (0, 1, 2)]
    shapes = {"felt": (2, 2), "slot": (2,), "apart": (2, 2), "stays": (2,)}
    found = {name: np.zeros((1, 6, *shapes[name])) for name in PAIRS}
    settle(pairs, found)
    assert [len(one.apart) for one in pairs] == [2, 4, 4]

    change, felt, expected = np.eye(2), {}, None
    for t in range(6):
        felt |= {one: pair.felt @ change for one, pair in enumerate(pairs) if pair.place[1] == t}
        change = matrices[t, 0] @ change
        flying = np.zeros((2, 2))
        for one, pair in enumerate(pairs):
            step = t - pair.place[1]
            if 0 <= step < len(pair.apart):
                added = np.outer(pair.apart[step], felt[one])
                if step == len(pair.apart) - 1:
                    change = change + added
                else:
                    flying += added
        expected = change + flying
    total = _through({"state": matrices} | {name: x.swapaxes(0, 1) for name, x in found.items()}, ["state"])
    np.testing.assert_allclose(total["state"][0], expected, rtol=1e-12)
