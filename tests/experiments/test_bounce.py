"""The report on bounces from made-up numbers; a small run, which takes a minute; and what cannot be run."""

import csv
import tomllib

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.bounce import Outcome, Settings, drawings, findings, grid_of, tables, verdict
from experiments.config import ConfigurationError, load_runs
from experiments.motion import ARMS, CONTINUOUS, DISCRETE, SLOPE
from experiments.theme import save
from mjxgrad.diagnostics import compare_to_slope, phases

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


@pytest.fixture
def outcome():
    """Heights of slope 2 at every contact; the discrete derivative is 5, the event one 2.2, that with an onset 2."""
    settings = Settings.model_validate({**tomllib.loads(SETTINGS), "num_phases": 64}, strict=False)
    starts = phases(settings.heights, settings.num_phases)
    heights = 2 * starts[:, None, None, None, None] * np.ones((2, 2, 1, 2))

    def compared(derivative, name):
        return compare_to_slope(starts, heights, [np.full_like(heights, derivative)], (name,))

    found = [compared({DISCRETE: 5.0, SLOPE: 2.2, CONTINUOUS: 2.0}[arm], arm) for arm in ARMS]
    # Less the restitution, in closed form under the first impedance alone, and how long the contact lasts (s).
    truths = np.array([[2.0, 2.0, 0.04], [2.0, np.nan, 0.04]]) * np.ones((2, 1, 1, 1))
    return Outcome(settings, grid_of(settings, found, compared(2.1, "wide"), truths))


def test_the_verdict_counts_where_the_derivatives_hold(outcome):
    # Two damping ratios and two impedances at each time step; only the onset is within 5 %, the slope at MuJoCo's motion
    # within 30.
    assert verdict(outcome) == (
        "Up to 0.5 ms the mean derivative is within 5% of the slope at 4 (continuous onset), 0 (slope) and 0 (discrete) of 4 "
        "contacts and time steps. At 2 ms it is within 30% at 4 and 4 (slope) of 4."
    )
    jumps, gentle, wide, truth = findings(outcome)
    assert "is 2.5 times the slope" in jumps
    assert "differ by 140% of the slope" in gentle
    assert "off by 5% of the slope" in wide
    assert "agree to 0e+00" in truth
    # 0.04 s are 80 steps of 0.5 ms and 20 of 2 ms.
    assert [row[:3] for row in tables(outcome)[0].rows] == [["20 and more", "8", "8"]]


def test_every_contact_and_time_step_is_in_metrics_and_figures(outcome, tmp_path):
    assert len(outcome.rows()) == 3 * 8
    assert [figure.file for figure in save(drawings(outcome), outcome, tmp_path)] == [
        "figures/derivative.svg",
        "figures/error.svg",
    ]


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
