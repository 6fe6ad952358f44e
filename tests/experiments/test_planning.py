"""The report on plans, from numbers with known answers, and a small run from file to folder."""

import json

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.planning import Attempt, Outcome, Settings, answer, drawings, tables, verdict
from experiments.theme import save

SETTINGS = Settings(experiment="planning", goal=(0.1, 0.0, 0.0))


def attempt(model, reach):
    """The rod goes along x, straight and at the height of its goal, from 0 to `reach`."""
    states = np.zeros((5, 10))
    states[:, 2] = np.linspace(0, reach, 5)
    cost = np.array([0.5, 0.4, 50 * (0.1 - reach) ** 2])
    course = {"cost": cost, "smoothed_cost": cost[1:], "length": np.array([0.05, 0.01]), "step": np.array([1.0, 0.0])}
    return Attempt(model, 3.0, states, np.zeros((4, 2)), course)


def outcome(*attempts):
    return Outcome(SETTINGS, list(attempts), attempts[0].states[:, :5], 0.01)


def test_a_goal_is_reached_only_within_every_tolerance():
    near, turned, aside = attempt("analytic", 0.081), attempt("analytic", 0.1), attempt("analytic", 0.1)
    turned.states[-1, 4], aside.states[-1, 3] = 0.16, -0.021
    found = outcome(near)
    assert found.is_solved(near)
    assert not any(map(found.is_solved, (attempt("analytic", 0.079), turned, aside)))


@pytest.mark.parametrize("share", [0.5, -0.5])
def test_the_share_of_the_way_is_that_of_the_coordinate_farthest_off(share):
    found = outcome(attempt("analytic", 0.1 * share))
    assert found.moved(found.attempts[0]) == pytest.approx(share)


def test_the_report_says_who_arrives_and_who_does_not_move(tmp_path):
    found = outcome(attempt("analytic", 0.099), attempt("none", 0.0))
    assert "reaches its goal to 1.0 mm and 0.000 rad; with no smoothing the rod does not move" in verdict(found)
    assert answer(found) == "Yes, with smoothed models; no, with plain ones."
    assert tables(found)[0].rows[0][1:5] == ["yes", "1.0 mm", "0.000 rad", "1 of 2"]
    assert len(save(drawings(found), tmp_path)) == 2


@pytest.mark.slow
def test_a_rod_that_is_not_touched_is_pushed_on_smoothed_models_alone(tmp_path):
    settings = (
        "finger=[0.0,-0.08] goal=[0.0,0.04,0.0] horizon=8 num_iterations=24 position_tolerance=0.01 video.speed=10"
    )
    assert main(["run", "planar_push", *settings.split(), "--output", str(tmp_path)]) == 0
    said = json.loads((tmp_path / "planar_push" / "summary.json").read_text())["verdict"]
    assert "reaches its goal" in said
    assert "with no smoothing the rod does not move at all" in said
