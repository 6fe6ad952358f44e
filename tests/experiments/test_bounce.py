"""A run on bounces, small, from its file to its folder, which takes a minute; and what cannot be run."""

import csv
import json

import pytest

from experiments.__main__ import main
from experiments.config import load_runs
from experiments.failure import ConfigurationError

SETTINGS = """\
# Is it the restitution?
experiment = "bounce"
damping_ratios = [0.6, 1.0]
time_constants = [0.02]
timesteps = [5e-4, 2e-3]
num_phases = 32
heights = [0.005, 0.025]
duration = 0.08
impedances = [{ first = 0.9, last = 0.9 }, { first = 0.0, last = 0.9, width = 0.01 }]
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bounce")
    (folder / "ball.toml").write_text(SETTINGS)
    assert main(["run", str(folder / "ball.toml"), "--output", str(folder)]) == 0
    return folder / "ball"


@pytest.mark.slow
def test_the_metrics_hold_derivatives_slopes_and_both_truths(finished):
    with (finished / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 8
    for row in rows:
        if row["impedance_first"] == "0.9":
            assert float(row["truth"]) == pytest.approx(float(row["closed_form"]), rel=1e-7)
        if row["timestep"] == "0.0005" and row["arm"] == "continuous onset":
            # Right to first order in the step.
            assert float(row["slope"]) == pytest.approx(float(row["truth"]), rel=0.1)


@pytest.mark.slow
def test_the_verdict_counts_where_the_derivatives_hold(finished):
    verdict = json.loads((finished / "summary.json").read_text())["verdict"]
    assert "Up to 0.5 ms the mean derivative is within 5% of the slope at 4 (continuous onset), " in verdict
    assert "At 2 ms it is within 30% at " in verdict
    assert sorted(path.stem for path in (finished / "figures").iterdir()) == ["derivative", "error"]


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("timesteps=[2e-3, 5e-4]", "timesteps must increase"),
        ("heights=[0.02, 0.01]", "heights must be two numbers, the smaller one first"),
        ("duration=0.02", "duration must be longer than heights"),
        ("num_phases=8", "num_phases"),
    ],
)
def test_settings_that_cannot_be_are_a_sentence(tmp_path, override, sentence):
    (tmp_path / "ball.toml").write_text(SETTINGS)
    with pytest.raises(ConfigurationError, match=sentence):
        load_runs(str(tmp_path / "ball.toml"), [override])
