"""A run on a textbook problem, small, from its file to its folder."""

import csv
import json

import pytest

from experiments.__main__ import main
from experiments.config import ConfigurationError, load_runs

SETTINGS = """\
# Does stiffness matter?
experiment = "textbook"
problem = "soft_heaviside"
point = 0.03
stddev = 0.1
stiffness = [3.0, 1e4]
shown_stiffness = 3.0
samples_at_stiffness = 10
num_samples = [10, 40]
num_repeats = 200
estimators = [{ name = "first_order" }, { name = "zeroth_order" }]
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("textbook")
    (folder / "steep.toml").write_text(SETTINGS)
    assert main(["run", str(folder / "steep.toml"), "--output", str(folder)]) == 0
    return folder / "steep"


def test_the_metrics_hold_measured_and_exact_errors_that_agree(finished):
    with (finished / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    # At 1/ν = 10⁴ hardly an estimate of ten samples hits the slope: no repetition can tell its error.
    for row in rows:
        if float(row["stiffness"]) == 3.0:
            assert float(row["rmse"]) == pytest.approx(float(row["exact_rmse"]), rel=0.25)
            assert int(row["num_rollouts"]) in (10, 40)


def test_the_verdict_says_from_which_stiffness_on_zeroth_order_is_closer(finished):
    verdict = json.loads((finished / "summary.json").read_text())["verdict"]
    assert "the smallest error is that of first order" in verdict
    assert "first order is closer up to stiffness 1/ν = 3" in verdict or "zeroth order is closer at" in verdict
    assert sorted(path.stem for path in (finished / "figures").iterdir()) == ["problem", "samples", "stiffness"]


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("stiffness=[1.0]", "soft_heaviside needs at least two values of stiffness"),
        ('problem="heaviside"', "stiffness and shown_stiffness must not be set"),
        ('estimators=[{name="first_order"}, {name="first_order"}]', "estimators: must differ, got first order more"),
        ('estimators=[{name="first_order", baselin="none"}]', 'did you mean "baseline"'),
        ('estimators=[{name="zeroth_ordr"}]', 'did you mean "zeroth_order"'),
    ],
)
def test_settings_that_cannot_be_are_a_sentence(tmp_path, override, sentence):
    (tmp_path / "steep.toml").write_text(SETTINGS)
    with pytest.raises(ConfigurationError, match=sentence):
        load_runs(str(tmp_path / "steep.toml"), [override])
