"""The mean of many motions finds what least squares with the true covariance would, chatter and noisy starts included."""

import dataclasses
import functools

import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.identification import Recording
from mjxgrad.identification.ensemble import LARGEST, Regression, fit
from mjxgrad.identification.normal import split
from mjxgrad.identification.recording import after_start, spread, stack

_NUMBERS, _WINDOWS, _TRUE = 60, 2, np.array([0.3, -0.2])


def _problem(noise, chatter, rng):
    """Linear residuals with noisy starts; what chatters jumps with the last digits of the values, as if at random."""
    slope = 5 * rng.normal(size=(_WINDOWS, _NUMBERS, 2))
    by_start = rng.normal(size=(_WINDOWS, _NUMBERS, 3))
    phases = rng.uniform(1e7, 2e7, (_WINDOWS, _NUMBERS))

    def motions(points, starts):
        jumps = np.sqrt(2) * chatter * np.sin(phases * points.sum(axis=1)[:, None, None])
        return np.einsum("wnd,md->mwn", slope, points) + np.einsum("wns,mws->mwn", by_start, starts) + jumps - recorded

    recorded = 0.0
    recorded = motions(_TRUE[None], noise * rng.normal(size=(1, _WINDOWS, 3)))[0] + noise * rng.normal(
        size=phases.shape
    )
    return motions, slope, recorded, by_start, (noise**2 + chatter**2) * np.eye(_NUMBERS)


@pytest.mark.parametrize("chatter", [0.0, 3.0])
def test_values_and_covariance_are_those_of_generalised_least_squares(chatter):
    """With 192 motions variances scatter by √(2/192) = 10 %; 60 eigenvalues of a sampled covariance add as much."""
    motions, slope, recorded, by_start, noise = _problem(1.0, chatter, np.random.default_rng(0))
    point = np.zeros(2), np.zeros((_WINDOWS, 3))
    found = fit(
        motions, point, (np.ones(2), np.ones((_WINDOWS, 3))), (-np.ones(2), np.ones(2)), 1.0, 126, lambda *_: None
    )
    # The starts are unknown: what they explain tells nothing of the values.
    weights = np.linalg.inv(noise)
    across = weights - weights @ by_start @ np.linalg.inv(by_start.swapaxes(1, 2) @ weights @ by_start) @ (
        by_start.swapaxes(1, 2) @ weights
    )
    inverse = np.linalg.inv(np.einsum("wni,wnm,wmj->ij", slope, across, slope))
    expected = inverse @ np.einsum("wni,wnm,wm->i", slope, across, recorded)
    error = np.sqrt(np.diag(inverse))
    assert found.is_settled
    np.testing.assert_array_less(np.abs(found.values - expected) / error, 0.7)
    *_, at_end, _ = split(found.factors, 2)
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(at_end.T @ at_end))), error, rtol=0.3)
    assert found.squares < 1.5 * 126


@pytest.mark.parametrize(("count", "expected"), [(4000, 1.0), (100, 1.6)])
def test_motions_taken_for_recordings_tell_how_sure_the_values_are(count, expected):
    """Of 100 motions a covariance of 60 numbers is known so badly that errors exceed their standard errors by half and more."""
    rng = np.random.default_rng(0)
    motions, *_ = _problem(1.0, 3.0, rng)
    draw = lambda num: (0.1 * rng.normal(size=(num, 2)), rng.normal(size=(num, _WINDOWS, 3)))  # noqa: E731
    told, others = draw(count), draw(500)
    found = Regression(*told, motions(*told)).errors(others[0], motions(*others), 1.0, 1.0)
    size = float(np.sqrt(np.mean(found**2)))
    assert abs(size / expected - 1) < 0.25


def test_chatter_does_not_tell_apart_what_has_one_effect():
    """Two numbers whose sum alone is seen beside a third: of 192 motions derivatives of the two differ by chatter."""
    rng = np.random.default_rng(0)
    motions, *_ = _problem(1.0, 3.0, rng)
    drawn, starts = 0.1 * rng.normal(size=(192, 3)), rng.normal(size=(192, _WINDOWS, 3))
    model = Regression(drawn, starts, motions(np.column_stack([drawn[:, 0] + drawn[:, 1], drawn[:, 2]]), starts))
    *_, slope, _ = split(model.weighed(1.0), 3)
    np.testing.assert_allclose(slope[:, 0], slope[:, 1], atol=0.2 * np.abs(slope[:, 0]).max())
    _, sizes, right = np.linalg.svd(slope)
    assert sizes[2] < 1e-9 * sizes[1]
    np.testing.assert_allclose(np.abs(right[2]), np.sqrt([0.5, 0.5, 0.0]), atol=0.05)


def test_motions_that_diverge_do_not_count_unless_most_do():
    motions, *_ = _problem(1.0, 0.0, np.random.default_rng(0))

    def diverging(share, values, starts):
        return np.where(np.arange(len(values))[:, None, None] % 10 < share, np.inf, motions(values, starts))

    given = (np.zeros(2), np.zeros((_WINDOWS, 3))), (np.ones(2), np.ones((_WINDOWS, 3))), (-np.ones(2), np.ones(2))
    found = fit(functools.partial(diverging, 3), *given, 1.0, 120, lambda *_: None)
    np.testing.assert_allclose(found.values, _TRUE, atol=0.1)
    with pytest.raises(mg.DivergedError, match="about the best values, got few"):
        fit(functools.partial(diverging, 10), *given, 1.0, 120, lambda *_: None)


def test_the_best_of_ensembles_that_do_not_settle_is_returned():
    """Motions part from the recording ever more, as where an ensemble has missed: the second of them is the best."""
    away, told = iter([40.0, 20.0]), []
    linear, *_ = _problem(1.0, 0.0, np.random.default_rng(0))
    apart = np.random.default_rng(1).normal(size=(_WINDOWS, _NUMBERS))

    def motions(values, starts):
        return linear(values, starts) + next(away, 80.0) * apart

    given = (np.zeros(2), np.zeros((_WINDOWS, 3))), (np.ones(2), np.ones((_WINDOWS, 3))), (-np.ones(2), np.ones(2))
    found = fit(motions, *given, 1.0, 120, lambda best, squares, num, ahead: told.append((best, squares, ahead)))
    assert not found.is_settled
    assert found.squares == min(squares for _, squares, _ in told) == told[1][1] < told[-1][1]
    assert all(best.squares == min(squares for _, squares, _ in told[: i + 1]) for i, (best, *_) in enumerate(told))
    assert min(ahead for *_, (ahead, _) in told[:-1]) > 0


def test_the_motions_to_come_are_bounded_by_a_number_that_falls():
    """Motions that are ever farther away never settle, and ensembles grow to four times their size: the dearest search."""
    linear, *_ = _problem(1.0, 0.0, np.random.default_rng(0))
    apart, spent, told = np.random.default_rng(1).normal(size=(_WINDOWS, _NUMBERS)), [], []

    def motions(values, starts):
        spent.append(len(values))
        return linear(values, starts) + 20.0 * len(spent) * apart

    given = (np.zeros(2), np.zeros((_WINDOWS, 3))), (np.ones(2), np.ones((_WINDOWS, 3))), (-np.ones(2), np.ones(2))
    fit(motions, *given, 1.0, 120, lambda best, squares, num, ahead: told.append((sum(spent), *ahead)))
    assert max(spent) == 4 * spent[0]
    at, about, most = np.array(told).T
    assert (np.diff(most) < 0).all()
    assert (about <= most).all()
    assert (at[:-1] + most[:-1] >= sum(spent)).all()
    assert sum(spent) <= LARGEST * spent[0]


def test_the_start_is_as_noisy_as_the_first_row_that_gives_it():
    scene = mg.load_scene("""<mujoco><worldbody><body><freejoint name="root"/><geom size=".1" mass="1"/>
        <body><joint name="x" axis="1 0 0"/><geom size=".1" mass="1"/></body></body></worldbody></mujoco>""")
    row = np.array([[0.0, 0.1, np.nan, np.nan, np.nan, np.nan, np.nan, 0.2]])
    one = Recording({"qpos": np.tile(row, (3, 1))}, times=[0, 0.01, 0.02], noise={"qpos": 0.001})
    given = dataclasses.replace(one, start=mg.initial_state(scene))
    late = dataclasses.replace(one, times=[0.01, 0.02, 0.03])
    measured = np.repeat([0.001, 0, 0.001, 0], [2, 4, 1, 7])
    np.testing.assert_array_equal(spread(scene, [one, given, late], None), [measured, 0 * measured, 0 * measured])
    np.testing.assert_array_equal(spread(scene, [given], True), [measured])
    counted = after_start(stack(scene, [one]), spread(scene, [one], None)).weight["qpos"][0, :, [0, 1, 6]]
    np.testing.assert_allclose(
        counted, np.tile([0, 1000, 1000], (3, 1))
    )  # the first row is the start, and no measurement
    np.testing.assert_array_equal(spread(scene, [one], False), [0 * measured])


def test_an_ensemble_that_got_too_wide_narrows_again():
    """The mean of a wide one explains less than that of the first, so that wider ones would explain ever less."""
    linear, *_ = _problem(1.0, 0.0, np.random.default_rng(0))
    apart, widths = np.random.default_rng(1).normal(size=(_WINDOWS, _NUMBERS)), []

    def motions(values, starts):
        widths.append(values.std())
        return linear(values, starts) + (2.0 + 20.0 * widths[-1]) * apart

    point, first = (np.zeros(2), np.zeros((_WINDOWS, 3))), (np.full(2, 0.3), np.ones((_WINDOWS, 3)))
    fit(motions, point, first, (np.full(2, -1e9), np.full(2, 1e9)), 1.0, 120, lambda *_: None)
    assert max(widths) < 10 * widths[0]
