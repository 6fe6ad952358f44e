"""The report on plans, from numbers with known answers; and small runs from file to folder, which take a minute."""

import csv
import json

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.config import ConfigurationError, load_runs
from experiments.planning.measure import Attempt, Outcome
from experiments.planning.report import drawings, findings, tables, verdict
from experiments.planning.settings import Settings
from experiments.theme import save

GOAL = (0.1, 0.0, 0.0)
TRAJECTORY = Settings(experiment="planning", method="trajectory", goal=GOAL)
TREE = Settings(experiment="planning", method="tree", goal=GOAL)


def attempt(model, reach, *, seed=0, num_steps=4, is_tree=False):
    """The rod goes along x, straight and at the height of its goal, from 0 to `reach`."""
    states = np.zeros((num_steps + 1, 10))
    states[:, 2] = np.linspace(0, reach, num_steps + 1)
    if is_tree:
        course = {"error": np.array([5.0, max(0.1, (GOAL[0] - reach) / 0.02)])}
        return Attempt(model, seed, 3.0, states, np.zeros((num_steps, 2)), course, states, np.arange(-1, num_steps))
    cost = np.array([0.5, 0.4, 0.5 * (GOAL[0] - reach) ** 2 * 100])
    course = {"cost": cost, "smoothed_cost": cost[1:], "length": np.array([0.05, 0.01]), "step": np.array([1.0, 0.0])}
    return Attempt(model, seed, 3.0, states, np.zeros((num_steps, 2)), course)


def outcome(settings, attempts, polished=None):
    best = Outcome(settings, attempts, polished, np.zeros((1, 5)), 0.01).best
    return Outcome(settings, attempts, polished, best.states[:, :5], 0.01)


def test_a_goal_is_reached_only_within_every_tolerance():
    settings, near = TRAJECTORY, attempt("analytic", 0.081)
    turned, aside = attempt("analytic", 0.1), attempt("analytic", 0.1)
    turned.states[-1, 4], aside.states[-1, 3] = 0.16, -0.021
    found = outcome(settings, [near])
    assert found.is_solved(near)
    assert not found.is_solved(attempt("analytic", 0.079))
    assert not found.is_solved(turned)
    assert not found.is_solved(aside)


def test_the_share_of_the_way_is_that_of_the_coordinate_farthest_off():
    found = outcome(TRAJECTORY, [attempt("analytic", 0.05)])
    assert found.moved(found.attempts[0]) == pytest.approx(0.5)
    backwards = attempt("analytic", -0.05)
    assert found.moved(backwards) == pytest.approx(-0.5)


def test_the_shortest_solved_way_is_shown_and_otherwise_the_nearest():
    solved = [attempt("analytic", 0.1, seed=i, num_steps=n, is_tree=True) for i, n in enumerate((9, 6, 8))]
    assert outcome(TREE, solved).best is solved[1]
    lost = [attempt("analytic", x, seed=i, is_tree=True) for i, x in enumerate((0.01, 0.05, 0.03))]
    assert outcome(TREE, lost).best is lost[1]


def test_the_verdict_on_a_trajectory_says_who_arrives_and_who_does_not_move():
    found = outcome(TRAJECTORY, [attempt("analytic", 0.099), attempt("none", 0.0)])
    assert verdict(found) == (
        "With analytic models the rod reaches its goal to 1.0 mm and 0.000 rad; "
        "with no smoothing the rod does not move at all."
    )
    assert tables(found)[0].rows[0][3:7] == ["1.0 mm", "0.000 rad", "4", "1 of 2"]


def test_the_verdict_on_trees_counts_the_seeds():
    found = [attempt("analytic", 0.1, seed=0, is_tree=True), attempt("analytic", 0.02, seed=1, is_tree=True)]
    lost = [attempt("none", x, seed=i, is_tree=True) for i, x in enumerate((0.0, 0.01))]
    said = verdict(outcome(TREE, found + lost))
    assert said == (
        "With analytic models 1 of 2 trees find a way, the shortest of 4 steps; with no smoothing none of 2 trees finds a way."
    )
    assert [row[2] for row in tables(outcome(TREE, found + lost))[0].rows] == ["yes", "no", "no", "no"]


def test_polishing_is_reported_with_what_it_gained():
    found = outcome(TREE, [attempt("analytic", 0.09, is_tree=True)], attempt("analytic", 0.1))
    assert (
        "from 10.0 mm and 0.000 rad to 0.0 mm and 0.000 rad, and its cost from 0.500 to 0.00, in 3 s."
        in findings(found)[1]
    )
    assert [row["model"] for row in found.rows()] == ["analytic", "analytic polished"]


@pytest.mark.parametrize(
    ("settings", "is_tree", "files"),
    [(TRAJECTORY, False, ["cost", "plane", "pose"]), (TREE, True, ["plane", "pose", "tree"])],
)
def test_every_method_gets_its_figures(tmp_path, settings, is_tree, files):
    attempts = [attempt("analytic", 0.1, is_tree=is_tree), attempt("none", 0.0, is_tree=is_tree)]
    found = outcome(settings, attempts)
    figures = save(drawings(found), found, tmp_path)
    assert sorted((tmp_path / figure.file).stem for figure in figures) == files


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ('models=["analytic", "analytic"]', "models: must differ, got analytic more than once"),
        ("last_length=0.1", "last_length must be at most length"),
        ("num_samples=5", "num_samples"),
        ('method="guess"', "method"),
    ],
)
def test_settings_that_cannot_be_are_a_sentence(override, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        load_runs("planar_push", [override])


def _run(folder, settings):
    """Run without a video; return the verdict and the rows of the metrics."""
    (folder / "near.toml").write_text(f'# Is it pushed?\nexperiment = "planning"\nfinger = [0.0, -0.08]\n{settings}')
    assert main(["run", str(folder / "near.toml"), "--output", str(folder)]) == 0
    with (folder / "near" / "metrics.csv").open() as file:
        return json.loads((folder / "near" / "summary.json").read_text())["verdict"], list(csv.DictReader(file))


@pytest.mark.slow
def test_a_rod_that_is_not_touched_is_pushed_on_smoothed_models_alone(tmp_path):
    settings = 'method = "trajectory"\ngoal = [0.0, 0.04, 0.0]\nhorizon = 8\nnum_iterations = 24\ntree.position_tolerance = 0.01'
    said, rows = _run(tmp_path, settings)
    assert [row["is_solved"] for row in rows] == ["True", "False"]
    assert "with no smoothing the rod does not move at all" in said


@pytest.mark.slow
def test_a_tree_pushes_a_rod_that_is_not_touched(tmp_path):
    settings = 'method = "tree"\nmodels = ["analytic"]\ngoal = [0.0, 0.08, 0.0]\nlength = 0.02\n'
    said, rows = _run(tmp_path, settings + "tree = { num_seeds = 1, capacity = 1500, polish_iterations = 0 }")
    assert rows[0]["is_solved"] == "True"
    assert "With analytic models the rod reaches its goal" in said
