"""The report on the sawtooth, from outcomes whose slope and teeth are known; and a whole run, which takes minutes."""

import json

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.motion import CONTINUOUS, DISCRETE, SLOPE
from experiments.sawtooth import NATIVE, POLICY, Outcome, course, drawings, verdict
from experiments.theme import save
from mjxgrad.diagnostics import compare_to_slope, phases

_START = phases((0.0, 1.0), 256)


def _course(tooth, continuous=2.0, **how):
    """An outcome of slope 2 and a sawtooth whose flanks have slope 5; the slope at MuJoCo's motion errs by 0.3."""
    teeth = tooth * ((_START / tooth) % 1 - 0.5) * 3
    flat = {DISCRETE: (2 * _START + teeth, 5.0), SLOPE: (2 * _START + teeth, 2.3)}
    flat[NATIVE] = flat[POLICY] = (2 * _START + teeth, 2.0)
    flat[CONTINUOUS] = (2 * _START + 0.01 * teeth, continuous)
    arms = {
        arm: compare_to_slope(
            _START, outcome[:, None, None] * np.ones((1, 2, 1)), [np.full((256, 2, 1), slope)], (arm,)
        )
        for arm, (outcome, slope) in flat.items()
    }
    return course("ball", "Ball", ("z",), 2e-3, np.array([0.1, 0.2]), arms, how.get("reference"))


def test_teeth_are_what_the_trend_leaves():
    found = _course(0.05)
    # A sawtooth of height 0.15 has a standard deviation of 0.15 / √12; 256 starts, 20 teeth.
    np.testing.assert_allclose(found.sawtooth.sel(arm=DISCRETE), 0.15 / np.sqrt(12), rtol=0.05)
    np.testing.assert_allclose(found.smaller, 100, rtol=1e-6)
    assert found.has_impact.all()
    assert (found["shift"] < 0.1).all()


def test_the_verdict_counts_the_readings_where_the_mean_derivative_is_the_slope():
    sentence = verdict(Outcome([_course(0.05)]))
    assert "100 times smaller in the median" in sentence
    assert "at 100% of 2 readings" in sentence
    assert "right at 100% by C MuJoCo and 0% by MJX, MuJoCo's own derivative at 0%" in sentence
    assert "at 0% of 2 readings" in verdict(Outcome([_course(0.05, continuous=2.5)]))


def test_a_motion_without_teeth_is_said_to_have_none():
    nothing = np.zeros((256, 2, 1))
    flat = {
        arm: compare_to_slope(_START, nothing, [nothing], (arm,))
        for arm in (DISCRETE, NATIVE, POLICY, SLOPE, CONTINUOUS)
    }
    assert verdict(Outcome([course("a", "A", ("z",), 2e-3, [0.1, 0.2], flat)])).startswith("Nothing touches")


def test_the_error_beside_the_converged_motion_is_that_of_each_arm():
    found = _course(0.05, reference=(2 * _START)[:, None, None] * np.ones((1, 2, 1)))
    np.testing.assert_allclose(found.closer, 0.01, rtol=1e-6)


def test_every_motion_gets_its_figure(tmp_path):
    outcome = Outcome([_course(0.05)])
    figures = save(drawings(outcome), tmp_path)
    assert [figure.file for figure in figures] == ["figures/teeth_ball.svg"]
    assert all((tmp_path / figure.file).is_file() for figure in figures)
    assert len(outcome.rows()) == 5 * 2


@pytest.mark.slow
def test_a_ball_on_a_plane_is_compared_from_file_to_report(tmp_path):
    """With spin and friction under default contact, single derivatives are near the slope and their mean is it."""
    command = ["run", "sawtooth", 'cases=["ball"]', "timesteps=[0.002]", "reference=4", "--output", str(tmp_path)]
    assert main(command) == 0
    sentence = json.loads((tmp_path / "sawtooth" / "summary.json").read_text())["verdict"]
    share = float(sentence.split("standard errors or 5% at ")[1].split("%")[0])
    assert share >= 90
