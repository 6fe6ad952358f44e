"""The report on trees, from numbers with known answers, the planar hand's replay, and a small run from file to folder."""

import json

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.theme import save
from experiments.tree import (
    ALONE,
    SMOOTHED,
    UNSMOOTHED,
    Attempt,
    Outcome,
    Problem,
    Settings,
    answer,
    drawings,
    tables,
    verdict,
)

SETTINGS = Settings(experiment="tree", hand="planar", angle=90.0, angle_tolerance=6.0)


def attempt(arm, error, nodes=4):
    """A tree that is a chain."""
    course, points = (
        np.linspace(15.0, error, nodes),
        np.stack([np.arange(nodes) / 100, np.linspace(0, 90, nodes)], axis=1),
    )
    return Attempt(arm, 0, course, points, np.arange(-1, nodes - 1), np.zeros((2, 14)), error, 6 * error, 3, 2.0)


def test_the_report_counts_replays_that_end_at_the_goal(tmp_path):
    found = Outcome(
        SETTINGS, [attempt(SMOOTHED, 0.5), attempt(SMOOTHED, 1.1), attempt(UNSMOOTHED, 1.01), attempt(ALONE, 15.0, 1)]
    )
    assert answer(found) == "Smoothed tree 1 of 2, unsmoothed tree 0 of 1, trajectory optimisation 0 of 1."
    assert "Smoothed tree turns the body from 1 of 2 seeds after 4 nodes and 2.0 s to 3° (medians)." in verdict(found)
    assert "Unsmoothed tree turns the body from no seed." in verdict(found)
    assert len(tables(found)[0].rows) == 4
    assert len(save(drawings(found), tmp_path)) == 1


def test_a_replay_is_the_motion_that_the_tree_saw():
    """Fingers that push the disc aside: steps of the system, each from a state alone, and one motion of C MuJoCo."""
    problem = Problem(SETTINGS)
    controls = problem.control + np.linspace(0, -0.5, 4)[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
    states = problem.replayed(controls)
    state = problem.start
    for control in controls:
        state = problem.system.step(state, control)
    # Each step solves from another start than the motion's, to the solver's tolerance.
    np.testing.assert_allclose(state, states[-1], atol=1e-6)
    assert np.linalg.norm(states[-1, problem.place]) > 0.02


@pytest.mark.slow
def test_a_planar_hand_turns_a_disc_on_smoothed_models_alone(tmp_path):
    settings = "angle=45.0 sizes.num_seeds=1 sizes.capacity=400 video.speed=10"
    assert main(["run", "planar_hand", *settings.split(), "--output", str(tmp_path)]) == 0
    said = json.loads((tmp_path / "planar_hand" / "summary.json").read_text())
    assert said["answer"].startswith("Smoothed tree 1 of 1")
    assert said["answer"].endswith("trajectory optimisation 0 of 1.")
