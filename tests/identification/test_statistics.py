"""What residuals and their derivative say of parameters: intervals, what has no effect, what cannot be told apart."""

from types import SimpleNamespace

import numpy as np
import pytest

from mjxgrad.identification.normal import distinct, factors_of, solved, split
from mjxgrad.identification.parameters import Coordinates, Parameter
from mjxgrad.identification.result import statistics


def _coordinates(**nominal):
    return Coordinates.of({name: Parameter(value, -10.0, 10.0) for name, value in nominal.items()})


def _judge(slope, residual, **nominal):
    values = np.array(list(nominal.values()), float)
    return SimpleNamespace(**statistics(_coordinates(**nominal), values, residual @ residual, slope, len(residual), 0))


def test_intervals_cover_as_often_as_they_say():
    """600 regressions on 12 numbers, so few that Student's distribution is not the normal one (2.3 in place of 2.0 errors)."""
    rng = np.random.default_rng(0)
    design = rng.normal(size=(12, 3)) @ np.array([[1, 0.9, 0], [0, 1, 0], [0, 0.3, 2]])
    truth, covered = np.array([1.0, -2.0, 0.5]), []
    for _ in range(600):
        measured = design @ truth + 0.3 * rng.normal(size=12)
        fit = np.linalg.lstsq(design, measured, rcond=None)[0]
        found = _judge(design, design @ fit - measured, a=fit[0], b=fit[1], c=fit[2])
        covered.append(np.abs(fit - truth) < found.half_width)
    share = np.mean(covered, axis=0)
    error = np.sqrt(0.95 * 0.05 / 600)
    np.testing.assert_allclose(share, 0.95, atol=3.5 * error)


def test_what_has_no_effect_is_named_and_leaves_the_others_their_intervals():
    rng = np.random.default_rng(2)
    design = rng.normal(size=(20, 2))
    residual = rng.normal(size=20)
    with_idle = np.column_stack([design[:, 0], np.zeros(20), design[:, 1]])
    found, alone = _judge(with_idle, residual, a=1.0, idle=1.0, b=1.0), _judge(design, residual, a=1.0, b=1.0)
    assert found.without_effect == ("idle",)
    assert found.inseparable == ()
    np.testing.assert_allclose(found.half_width, [alone.half_width[0], np.inf, alone.half_width[1]])
    assert found.condition_number == pytest.approx(alone.condition_number)


def test_combinations_that_cannot_be_told_apart_are_named_with_their_shares():
    """Only a/b² and c·d are seen, and e: a by 1 % with b by half of it, c by 1 % with d by −1 %."""
    rng = np.random.default_rng(3)
    first, second, third = rng.normal(size=(3, 25))
    a, b, c, d, e = 2.0, 3.0, -0.5, 4.0, 1.0
    slope = np.column_stack([first / b**2, -2 * a * first / b**3, second * d, second * c, third])
    found = _judge(slope, rng.normal(size=25), a=a, b=b, c=c, d=d, e=e)
    named = {tuple(sorted(one)): one for one in found.inseparable}
    assert set(named) == {("a", "b"), ("c", "d")}
    assert named["a", "b"]["b"] / named["a", "b"]["a"] == pytest.approx(0.5)
    assert named["c", "d"]["d"] / named["c", "d"]["c"] == pytest.approx(-1.0)
    np.testing.assert_array_equal(np.isfinite(found.half_width), [False, False, False, False, True])


def test_what_undoes_a_small_number_is_named_where_it_is_large_itself():
    """The sum alone is seen of 0.1 and 9: a per cent of the one is a ninetieth of a per cent of the other."""
    rng = np.random.default_rng(5)
    slope = rng.normal(size=25)[:, None] * np.ones(2)
    (combination,) = _judge(slope, rng.normal(size=25), a=0.1, b=9.0).inseparable
    assert combination == {"a": 0.01, "b": pytest.approx(-0.01 * 0.1 / 9.0)}


def test_columns_that_differ_by_their_errors_alone_are_not_told_apart():
    """Two numbers, a and b, have one effect; c and d differ by ten errors, and e has an effect of its own."""
    rng = np.random.default_rng(4)
    one, other, apart, last = rng.normal(size=(4, 200))
    exact = np.column_stack([2 * one, -3 * one, other, other + 0.1 * apart, last])
    slope = exact + 0.01 * rng.normal(size=exact.shape)
    expected = 1.3 * len(slope) * 0.01**2 * np.eye(5)  # chi-square of 200 is that much at three standard deviations
    found = slope @ distinct(slope.T @ slope, expected)
    (combination,) = _judge(found, rng.normal(size=200), a=1.0, b=1.0, c=1.0, d=1.0, e=1.0).inseparable
    assert combination == {"a": 0.01, "b": pytest.approx(0.01 * 2 / 3, rel=0.01)}
    np.testing.assert_allclose(found[:, 2:], slope[:, 2:], rtol=1e-12)
    np.testing.assert_array_equal(distinct(slope[:, 1:].T @ slope[:, 1:], expected[1:, 1:]), np.eye(4))
    # A number whose effect is less than its error is one that is not known, and no sum of others.
    weak = slope[:, 1:] * [1e-3, 1, 1, 1]
    np.testing.assert_array_equal(distinct(weak.T @ weak, expected[1:, 1:]), np.eye(4))


def test_unknown_starts_widen_the_intervals_as_in_one_regression_of_all():
    """Three windows with two offsets each: the parameters' block of the whole covariance."""
    rng = np.random.default_rng(6)
    shared, offsets, residual = rng.normal(size=(3, 9, 2)), rng.normal(size=(3, 9, 2)), rng.normal(size=(3, 9))
    whole = np.column_stack(
        [shared.reshape(27, 2), np.kron(np.eye(3), np.ones((9, 2))) * np.tile(offsets.reshape(27, 2), 3)]
    )
    *_, slope, flat = split(factors_of(residual, shared, offsets), 2)
    best, *_ = np.linalg.lstsq(whole, -residual.ravel(), rcond=None)
    left = residual.ravel() + whole @ best
    found = statistics(_coordinates(a=1.0, b=1.0), np.ones(2), left @ left, slope, 27, 6)
    expected = (left**2).sum() / (27 - 8) * np.linalg.inv(whole.T @ whole)[:2, :2]
    np.testing.assert_allclose(found["covariance"], expected, rtol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(flat + slope @ best[:2]), np.linalg.norm(left), rtol=1e-10)


def test_the_step_is_that_of_one_regression_of_all_and_stops_at_a_bound():
    """Two windows with an own offset each; where the best slope is beyond a bound, the others are the best beside it."""
    rng = np.random.default_rng(1)
    shared, offsets, residual = rng.normal(size=(2, 9, 2)), rng.normal(size=(2, 9, 1)), rng.normal(size=(2, 9))
    whole = np.zeros((18, 4))
    whole[:, :2], whole[:9, 2], whole[9:, 3] = shared.reshape(18, 2), offsets[0, :, 0], offsets[1, :, 0]
    best, *_ = np.linalg.lstsq(whole, -residual.ravel(), rcond=None)
    step = solved(factors_of(residual, shared, offsets), 2)
    np.testing.assert_allclose(np.append(step.values, step.starts), best, rtol=1e-9)
    half = best[0] / 2
    room = np.full(2, -9.0), np.full(2, 9.0)
    room[int(half > 0)][0] = half
    step = solved(factors_of(residual, shared, offsets), 2, room)
    others, *_ = np.linalg.lstsq(whole[:, 1:], -residual.ravel() - half * whole[:, 0], rcond=None)
    np.testing.assert_allclose(np.concatenate([step.values, step.starts.ravel()]), [half, *others], rtol=1e-6)
