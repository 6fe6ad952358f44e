"""The report on impacts, from numbers with known answers; and a whole run, which takes minutes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import main
from experiments.config import load_runs
from experiments.landing.captions import captions
from experiments.landing.cases import case, jittered_positions
from experiments.landing.figures import draw
from experiments.landing.outcome import Course, Outcome
from experiments.landing.settings import LandingSettings
from experiments.landing.verdict import findings, table, verdict
from mjxgrad.diagnostics import compare_to_slope, derivative_under_jitter, phases

SETTINGS = LandingSettings(experiment="landing", cases=("ball",), refinements=(1,), num_phases=64, num_times=4)


def course(event_error, *, is_torn=False):
    """An outcome of slope 2 at four times, of which the first is before the impact; the discrete derivative is 5."""
    x = phases((0.0, 1.0), 64)
    trend = np.sin(60 * x) if is_torn else 2 * x
    outcomes = np.repeat(trend[:, None, None], 4, axis=1)
    exact = np.full_like(outcomes, 2.0)
    found = compare_to_slope(x, outcomes, [exact + 3, exact + event_error])
    times, events = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.15])
    return Course("ball", "Ball", ("z",), 2e-3, 1, times, events, found, SETTINGS.tolerance)


def test_only_times_after_the_first_impact_are_counted():
    assert course(0.0).share("event") == (3, 0, 3)
    assert course(0.0).share("discrete") == (0, 3, 3)


def test_an_error_is_measured_by_the_discrete_gradients_own():
    """0.12 of 3 is 4 %, although it is 6 % of the slope."""
    assert course(0.12).worst("event") == pytest.approx(0.04, rel=1e-6)
    assert course(0.12).share("event") == (3, 0, 3)
    assert course(0.18).share("event") == (0, 3, 3)


def test_a_torn_outcome_judges_no_derivative():
    assert course(0.0, is_torn=True).share("event")[2] == 0
    assert "No slope is known well enough" in verdict(Outcome(SETTINGS, [[course(0.0, is_torn=True)]]))


def test_the_verdict_names_the_motions_where_it_does_not_hold():
    good, bad = Outcome(SETTINGS, [[course(0.0)]]), Outcome(SETTINGS, [[course(0.0), course(0.9)]])
    assert verdict(good) == (
        "After the first impact the event gradient is within 5% at 3 of 3 times and coordinates, the discrete one at 0. "
        "Nowhere is it farther off beyond chance."
    )
    assert "It is farther off beyond chance in Ball at 2 ms (3 of 3)." in verdict(bad)
    assert "5 where the slope is 2; the event gradient says 2." in findings(good)[0]
    assert table(bad).emphasised == {(1, 6)}


def jittered_course(draw_jitter):
    """An outcome of slope 2 + ξ at two times after the impact; the event derivative is right, the discrete 3 too large."""

    def simulate(x, jitter, gradient):
        error = 3 * (x - jax.lax.stop_gradient(x)) if gradient == "discrete" else 0.0
        return jnp.full((2, 1), (2 + jitter) * x + error)

    found = derivative_under_jitter(simulate, (0.0, 1.0), jax.random.key(0), jitter=draw_jitter)
    return Course("ball", "Ball", ("z",), 2e-3, 1, np.array([0.2, 0.3]), np.array([0.15]), found, SETTINGS.tolerance)


def test_a_motion_under_jitter_is_judged_and_drawn_as_others_are(tmp_path):
    settings = SETTINGS.model_copy(update={"average_over": "jitter"})
    outcome = Outcome(settings, [[jittered_course(lambda key: 0.1 * jax.random.normal(key))]])
    assert outcome.all[0].share("event") == (2, 0, 2)
    assert outcome.all[0].share("discrete") == (0, 2, 2)
    assert "256 starts" in captions(outcome)["derivative"]
    assert all((tmp_path / figure.file).is_file() for figure in draw(outcome, tmp_path, captions(outcome)))
    assert not any("doubtful" in sentence for sentence in findings(outcome))


def test_means_that_hang_on_a_few_starts_are_named():
    """One start in a hundred has another derivative than the rest."""
    outcome = Outcome(SETTINGS, [[jittered_course(lambda key: 1.0 * (jax.random.uniform(key) < 0.01))]])
    assert outcome.all[0].is_heavy.all()
    assert "are doubtful, in Ball at 2 ms (2 of 2)." in findings(outcome)[-1]


@pytest.mark.parametrize(("name", "chosen"), [("hopper", [3, 4, 5]), ("ant", list(range(7, 15))), ("two_balls", [])])
def test_jitter_moves_the_joints_of_other_bodies_and_no_quaternion(name, chosen):
    assert np.flatnonzero(jittered_positions(case(name))).tolist() == chosen


def test_every_motion_gets_its_figure(tmp_path):
    outcome = Outcome(SETTINGS, [[course(0.0)]])
    figures = draw(outcome, tmp_path, captions(outcome))
    assert [figure.file for figure in figures] == ["figures/error.png", "figures/derivative_ball.png"]
    assert all((tmp_path / figure.file).is_file() for figure in figures)
    assert len(outcome.rows()) == 4


@pytest.mark.parametrize("name", ["landing", "impacts", "bounce"])
def test_the_files_there_are_can_be_read(name):
    (run,) = load_runs(name, [])
    assert run.question.endswith("?")
    assert run.expected


def test_readings_between_time_steps_are_refused(tmp_path, capsys):
    assert main(["run", "impacts", "num_times=7", 'cases=["ball"]', "--output", str(tmp_path)]) == 2
    assert "num_times must divide the 120 steps of ball, got 7" in capsys.readouterr().err


@pytest.mark.slow
def test_a_ball_on_a_plane_is_compared_from_file_to_report(tmp_path):
    """At a quarter of its time step the derivative of an impact with spin and friction is the slope."""
    command = ["run", "impacts", 'cases=["ball"]', "refinements=[4]", "num_phases=32", "--output", str(tmp_path)]
    assert main(command) == 0
    sentence = json.loads((tmp_path / "impacts" / "summary.json").read_text())["verdict"]
    assert "Nowhere is it farther off beyond chance." in sentence
