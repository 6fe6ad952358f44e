"""The mean of many motions finds what least squares with the true covariance would, chatter and noisy starts included."""

import dataclasses
import functools

import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.identification import Recording
from mjxgrad.identification.ensemble import fit
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
    covariance = noise**2 * (np.eye(_NUMBERS) + by_start @ by_start.swapaxes(1, 2)) + chatter**2 * np.eye(_NUMBERS)
    return motions, slope, recorded, covariance


@pytest.mark.parametrize("knows_noise", [True, False])
@pytest.mark.parametrize("chatter", [0.0, 3.0])
def test_values_and_covariance_are_those_of_generalised_least_squares(knows_noise, chatter):
    """With 512 motions variances scatter by √(2/512) = 6 %; 60 eigenvalues of a sampled covariance add as much.

    The size of unknown noise is that of the likelihood's maximum, by 120 numbers: 1 ± 1/√240, if chatter does not hide it.
    """
    noise = 1.0 if knows_noise else 0.5
    motions, slope, recorded, covariance = _problem(noise, chatter, np.random.default_rng(0))
    low, high = -np.ones(2), np.ones(2)
    seen = {}

    def remembered(points, starts):
        return seen.setdefault(points.tobytes(), motions(points, starts))

    found = fit(
        remembered, (low, high), (_WINDOWS, 3), _WINDOWS * _NUMBERS, noise if knows_noise else None, lambda rms: None
    )
    weights = np.linalg.inv(covariance)
    inverse = np.linalg.inv(np.einsum("wni,wnm,wmj->ij", slope, weights, slope))
    expected = inverse @ np.einsum("wni,wnm,wm->i", slope, weights, recorded)
    error = np.sqrt(np.diag(inverse))
    assert found.is_settled
    np.testing.assert_array_less(np.abs(found.point - expected) / error, 0.7)
    of_found = np.sum(found.residual**2) / found.residual.size * np.linalg.inv(found.slope.T @ found.slope)
    np.testing.assert_allclose(np.sqrt(np.diag(of_found)), error, rtol=0.3)
    np.testing.assert_allclose(found.judged(seen[found.points.tobytes()]), found.residual, rtol=1e-6, atol=1e-9)
    if not chatter:
        squares = [np.sum(motions(point[None], starts[None]) ** 2) for point, starts in found.alone]
        others = np.sum(seen[found.points.tobytes()] ** 2, axis=(1, 2))
        np.testing.assert_array_less(np.max(squares), np.quantile(others, 0.05))
        np.testing.assert_allclose(found.noise, noise, rtol=0.2)


def test_motions_that_diverge_do_not_count_unless_most_do():
    motions, *_ = _problem(1.0, 0.0, np.random.default_rng(0))

    def diverging(share, points, starts):
        return np.where(np.arange(len(points))[:, None, None] % 10 < share, np.inf, motions(points, starts))

    box, shape = (-np.ones(2), np.ones(2)), (_WINDOWS, 3)
    found = fit(functools.partial(diverging, 3), box, shape, _WINDOWS * _NUMBERS, 1.0, lambda rms: None)
    np.testing.assert_allclose(found.point, _TRUE, atol=0.1)
    residuals = motions(found.points, np.zeros((len(found.points), *shape)))
    some = np.where(np.arange(len(residuals))[:, None, None] > 9, residuals, np.nan)
    assert np.isfinite(found.judged(some)).all()
    assert np.isinf(found.judged(np.full_like(residuals, np.inf))).all()
    with pytest.raises(mg.DivergedError, match="between the bounds, got few"):
        fit(functools.partial(diverging, 10), box, shape, _WINDOWS * _NUMBERS, 1.0, lambda rms: None)


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
