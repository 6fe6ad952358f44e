"""The experiment on policies: what it says is what was measured, and an interruption costs only what was not finished."""

import csv
import dataclasses
import importlib.util
import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import main
from experiments.config import ExperimentError
from experiments.learning import Course, Outcome, Settings, Sizes, findings, measure, verdict
from experiments.problems.gymnasium_v5 import gymnasium_returns
from experiments.workspace import Workspace
from mjxgrad import envs, learning

QUICK = Settings(
    experiment="learning",
    environment="cartpole",
    methods=("discrete", "zeroth"),
    size="quick",
    sizes=Sizes(num_seeds=2, num_updates=4, num_environments=2, num_episodes=2),
    num_substeps=None,
    window=16,
)


def course(method, returns, **history):
    zero = ("reward", "alpha", "agreement", "not_finite", "skipped", "diverged", "shortened")
    values = dict.fromkeys(zero, np.zeros((4, 2))) | dict.fromkeys(
        ("first_variance", "zeroth_variance"), np.ones((4, 2))
    )
    values |= {name: np.asarray(value, float) for name, value in history.items()}
    returns = np.asarray(returns, float)
    return Course(method, 1.0, values, returns, returns, {}, np.zeros((3, 2)), 3)


def test_the_verdict_names_the_best_in_mujoco():
    """Means over episodes 3 and 5, so 4 ± √2 over seeds; 256 steps are 4 updates of 2 environments of 16."""
    outcome = Outcome(QUICK, [course("zeroth", [[1, 1], [1, 1]]), course("discrete", [[2, 4], [4, 6]])], None)
    assert verdict(outcome) == "After 128 steps first order returns 4.0 ± 1.4 in C MuJoCo; zeroth order 1.00."


def test_what_was_left_out_is_said():
    """A share of a quarter in the last of four updates of both seeds."""
    lost = course("discrete", [[1, 1], [1, 1]], not_finite=[[0, 0], [0, 0], [0, 0], [0.25, 0.25]], skipped=np.eye(4, 2))
    sentences = findings(Outcome(QUICK, [lost], None))
    assert sentences[0] == (
        "First order: 6.2% of the derivatives were no numbers, 0 steps diverged, 2 updates were skipped."
    )
    assert findings(Outcome(QUICK, [course("discrete", [[1, 1], [1, 1]])], None))[0].startswith(
        "Every derivative was a number"
    )


def test_what_was_shortened_is_said_once_of_all():
    """A quarter of the values is one half: an eighth. Zeroth order has no derivatives to shorten."""
    shortened = np.repeat([[0.5], [0], [0], [0]], 2, axis=1)
    courses = [course(method, [[1, 1]] * 2, shortened=shortened) for method in ("discrete", "alpha", "zeroth")]
    assert findings(Outcome(QUICK, courses, None))[0] == (
        "Derivatives longer than 0.1 times zeroth-order noise were shortened to that: 12% (first order) and 12% (α-order)."
    )


def test_a_reward_that_falls_again_is_not_the_soonest():
    """Means over the updates so far: 0, 1, 2/3 and 1/2 against 0, 3/2, -1 and -3/4; half of the way is 1/4."""
    rewards = {"discrete": [0, 2, 0, 0], "zeroth": [0, 3, -6, 0]}
    courses = [course(name, [[1, 1]] * 2, reward=np.repeat([r], 2, axis=0).T) for name, r in rewards.items()]
    assert [one.method for one in Outcome(QUICK, courses, None).soonest] == ["discrete"]


@pytest.mark.slow
def test_the_quick_size_runs_and_keeps_its_course(tmp_path):
    sizes = (
        'size="quick" sizes.num_updates=2 sizes.num_episodes=1 video.width=64 methods=["discrete"] precision=float64'
    )
    assert main(["run", "learn_cartpole", *sizes.split(), "--output", str(tmp_path)]) == 0
    folder = tmp_path / "learn_cartpole"
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["update"] for row in rows] == ["1", "2"]
    assert "in C MuJoCo" in json.loads((folder / "summary.json").read_text())["verdict"]
    assert not list(tmp_path.glob(".learn_cartpole.kept-*"))


@pytest.mark.skipif(importlib.util.find_spec("brax") is not None, reason="brax is installed")
def test_without_brax_ppo_is_refused_before_the_others_learn(tmp_path):
    with pytest.raises(ExperimentError, match=r"pip install 'mjxgrad\[playground\]'"):
        measure(QUICK.model_copy(update={"methods": ("discrete", "ppo")}), Workspace(tmp_path))


@pytest.mark.parametrize(("name", "size"), [("hopper", 3), ("humanoid", 17)])
def test_gymnasium_itself_judges_as_our_environment_does(name, size, key):
    """A robot that pushes by half its strength, and falls; starts differ, so means of eight within five standard errors."""
    act = lambda obs: jnp.full(size, 0.5)  # noqa: E731
    fallen = dataclasses.replace(envs.load(name), episode_length=100)
    ours = np.asarray(learning.evaluate(fallen, act, key, num_episodes=8).returns)
    theirs = gymnasium_returns(name, act, num_episodes=8)
    assert abs(ours.mean() - theirs.mean()) < 5 * np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
