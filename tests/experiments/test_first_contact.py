"""The report on descents from where nothing touches, from numbers whose answer is known."""

import numpy as np
import pytest

from experiments.first_contact import MethodSettings, Outcome, Run, Settings, answer, findings, tables, verdict
from experiments.problems.untouched import hard_optimum


def run_of(label, *costs, hard=None, touches=False):
    return Run(
        method=MethodSettings(label=label), steps=np.arange(len(costs)), rollouts=2 * np.arange(len(costs)),
        cost=np.array(costs, float), best_cost=min(costs), hard_cost=hard and min(costs) + hard, farthest=0.001,
        qpos=np.zeros((3, 4)), touches_at_start=touches, num_skipped=0, seconds=1.0, compile_seconds=1.0,
    )  # fmt: skip


def outcome_of(task, runs, below):
    settings = Settings(
        experiment="first_contact", task=task, methods=tuple(run.method for run in runs), solved_below=below
    )
    return Outcome(settings, runs, start_gradient=0.0)


def test_the_verdict_tells_solved_from_stuck_and_hard_balls_have_a_say():
    runs = [
        run_of("near", 2.3, 1.395, hard=0.005),
        run_of("soft alone", 2.3, 1.4, hard=0.1),
        run_of("idle", 2.3, 1.9999, hard=0.1),
        run_of("touching", 2.3, 1.39, hard=0.005, touches=True),
    ]
    outcome = outcome_of("billiards", runs, 1.01 * hard_optimum()[0])
    assert answer(outcome) == "1 of 3 ways find it, best “near” (1.395); not “soft alone” or “idle”."
    told = verdict(outcome)
    assert "a cost below 1.4105 is reached by “near” (1.395), also when hard balls play their forces." in told
    assert "In between: “soft alone” (1.4); no progress: “idle” (2); what stays untouched costs 2." in told
    assert "From a start that touches: “touching” (1.39): solved." in told
    assert "zero, exactly" in findings(outcome)[0]


def test_a_cost_counts_from_where_on_it_stays_below():
    runs = [
        run_of("first order", 1, 1, 1, 1),
        run_of("margin", 1, 0.05, 0.4, 0.02),
        run_of("zeroth order", 1, 0.9, 0.8, 0.7),
    ]
    shown = tables(outcome_of("rolling_pin", runs, 0.1))[0]
    assert [row[5:7] for row in shown.rows] == [["never", ""], ["3", "6"], ["never", ""]]
    assert shown.rows[0][7] == "1.0"  # mm
    assert shown.emphasised == frozenset({(1, 3)})


def test_methods_of_one_label_are_refused():
    with pytest.raises(ValueError, match="must differ, got same more than once"):
        outcome_of("rolling_pin", 2 * [run_of("same", 1)], 0.1)
