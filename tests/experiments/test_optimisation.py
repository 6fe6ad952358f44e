"""The optimisation experiment: what it spends, how it compares, and what it says."""

import csv
import json

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from experiments.__main__ import main
from experiments.config import load_runs
from experiments.optimisation.measure import Difference, Outcome, Run
from experiments.optimisation.report import together, verdict
from experiments.optimisation.settings import MethodSettings, Settings

FILES = ("push_soft", "push_stiff", "friction", "lqr", "motion_planning", "tennis", "six_tasks")
SETTINGS = """\
# Which ends lowest?
experiment = "optimisation"
task = "push_soft"
seeds = 2
num_steps = 5
num_samples = 6
evaluations = 2
methods = [
    { name = "zeroth_order", baseline = "zero_noise" },
    { name = "alpha_order" },
    { name = "predictive_sampling" },
]
[sweep]
seed = [0]
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small sweep of one run."""
    folder = tmp_path_factory.mktemp("optimisation")
    (folder / "small.toml").write_text(SETTINGS)
    assert main(["run", str(folder / "small.toml"), "--output", str(folder), "--debug"]) == 0
    return folder / "small-sweep"


@pytest.fixture(scope="module")
def rows(finished):
    with (finished / "seed=0" / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def settings(*methods, **others):
    table = {"experiment": "optimisation", "task": "push_soft", "methods": list(methods), **others}
    return Settings.model_validate_json(json.dumps(table))


def made_up(name, costs, **options):
    """A method whose seeds end at some costs, from 1000."""
    costs = np.asarray(costs, float)
    curve = np.stack([np.full(costs.size, 1000.0), costs], axis=1)
    reasons = {"inconsistent": np.ones((costs.size, 3), bool)} if name == "alpha_order" else {}
    return Run(
        method=MethodSettings(name=name, **options),
        final_cost=costs,
        cost=curve,
        rollouts=np.array([0, 30]),
        seconds=np.array([0.0, 6.0]),
        alpha=np.zeros((costs.size, 3)),
        reasons=reasons,
        num_skipped=np.zeros(costs.size, int),
        finite_share=1.0,
        rollouts_per_step=10,
        compile_seconds=1.0,
    )


def outcome(*runs, reference=None):
    methods = [run.method.model_dump(exclude_unset=True) for run in runs]
    return Outcome(
        settings=settings(*methods),
        num_samples=10,
        num_steps=3,
        dim=2,
        start_cost=1000.0,
        reference=reference or {},
        runs=list(runs),
    )


def test_a_zero_noise_baseline_is_paid_from_the_rollouts_of_a_step(rows):
    """Six rollouts in each of five steps, whatever the method."""
    last = [row for row in rows if row["is_final"] == "True"]
    assert len(last) == 6
    assert {row["rollouts"] for row in last} == {"30"}


def test_an_evaluation_counts_what_was_spent_before_it(rows):
    """Two evaluations over five steps are due before steps 0 and 3, and one is made after the last."""
    spent = [int(row["rollouts"]) for row in rows if row["method"] == "α-order" and row["seed"] == "1"]
    assert spent == [0, 18, 30]


def test_the_page_of_a_sweep_sets_final_costs_side_by_side(finished, rows):
    cells = json.loads((finished / "seed=0" / "summary.json").read_text())["headline"]
    ends = [float(row["cost"]) for row in rows if row["method"] == "α-order" and row["is_final"] == "True"]
    page = (finished / "report.html").read_text()
    assert cells["α-order"].startswith(f"{np.mean(ends):.0f}")
    for heading, cell in cells.items():
        assert f'<th scope="col">{heading}</th>' in page
        assert f">{cell}</td>" in page


def test_a_sweep_over_tasks_is_answered_by_how_often_alpha_order_ends_worse():
    def summary(kind):
        return {"headline": {"α-order against the better": f"{kind}: +1"}}

    kinds = ("worse", "better", "cannot be told")
    assert together([summary(kind) for kind in kinds]) == "Worse on 1 of 3; better on 1; seeds cannot tell on 1."
    assert together([summary("better")] * 2) == "Never in 2; better on 2; seeds cannot tell on 0."
    assert together([summary("better"), {"headline": {}}]) is None


def test_the_interval_of_a_difference_is_that_of_welch():
    ours, other = [3.0, 5.0, 4.0, 9.0], [1.0, 2.0, 1.5]
    found = Difference.of(made_up("alpha_order", ours), made_up("first_order", other), 0.9)
    expected = stats.ttest_ind(ours, other, equal_var=False).confidence_interval(0.9)
    assert (found.low, found.high) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("ours", "above", "below"),
    [
        ([110.0, 111.0, 112.0, 113.0], True, False),
        ([90.0, 91.0, 92.0, 93.0], False, True),
        ([99.0, 100.0, 102.0, 101.5], False, False),
    ],
)
def test_a_difference_counts_where_it_is_beyond_seed_noise(ours, above, below):
    found = Difference.of(made_up("alpha_order", ours), made_up("first_order", [99.0, 101.0, 102.0, 100.0]), 0.95)
    assert (found.is_above, found.is_below) == (above, below)


def test_a_method_is_worse_by_its_ranks_where_one_wild_seed_hides_it_from_the_means():
    """All nine others of ours are above all of the other, whose one wild run makes its mean and its interval useless."""
    ours, other = [*range(110, 119), 121], [*range(100, 109), 5000]
    found = Difference.of(made_up("alpha_order", ours), made_up("first_order", other), 0.95)
    assert found.low < 0 < found.high
    assert found.is_above


def test_three_seeds_are_too_few_to_call_a_method_better():
    """However far apart, two times three ranks fall so by chance in 2 of 20 orders: two-sided p is 0.1."""
    few = [made_up("alpha_order", [1.0, 1.1, 0.9]), made_up("first_order", [500.0, 510.0, 490.0])]
    found = outcome(*few).verdicts[0]
    assert found.high < 0
    assert found.p_value == pytest.approx(0.1)
    assert not found.is_below
    assert "3 seeds cannot tell α-order from first order" in verdict(outcome(*few))
    assert "by the means alone" in verdict(outcome(made_up("alpha_order", [900.0, 901.0, 902.0]), few[1]))
    many = [made_up("alpha_order", [1.0, 1.1, 0.9, 1.2]), made_up("first_order", [500.0, 510.0, 490.0, 480.0])]
    assert "ends better than first order" in verdict(outcome(*many))


def test_published_results_stand_beside_the_methods_that_they_are_of():
    runs = [
        made_up("first_order", [1.0, 2.0]),
        made_up("zeroth_order", [1.0, 2.0]),
        made_up("zeroth_order", [1.0, 2.0], baseline="zero_noise"),
        made_up("alpha_order", [1.0, 2.0]),
        made_up("alpha_order", [1.0, 2.0], rule="bias_constrained", control_variate=False),
        made_up("alpha_order", [1.0, 2.0], rule="concavity", control_variate=False),
    ]
    reference = {"first": (1.0, 0.1), "zeroth": (2.0, 0.1), "alpha": (3.0, 0.1), "ddcg": (40.0, 0.1)}
    found = outcome(*runs, reference=reference)
    means = [result and result[0] for result in map(found.published, runs)]
    assert means == [1.0, None, 2.0, None, 3.0, 40.0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"methods": [{"name": "first_order", "rule": "concavity"}, {"name": "mppi"}]}, "first_order takes no rule"),
        ({"methods": [{"name": "mppi"}, {"name": "mppi"}]}, "must differ, got MPPI more than once"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(change, words):
    table = {"methods": [{"name": "first_order"}, {"name": "mppi"}]} | change
    with pytest.raises(ValidationError, match=words):
        settings(*table.pop("methods"), **table)


@pytest.mark.parametrize("name", FILES)
def test_every_file_shows_default_alpha_order_beside_first_and_zeroth_order(name):
    for run in load_runs(name, []):
        names = {method.name for method in run.settings.methods}
        assert {"first_order", "zeroth_order", "alpha_order"} <= names
        assert sum(method.is_default_alpha for method in run.settings.methods) == 1
        assert run.settings.seeds >= 6
