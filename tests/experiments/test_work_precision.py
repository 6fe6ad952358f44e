"""What the experiment on error against run time is built of; a small run from its file to its folder is slow."""

import csv
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from experiments.__main__ import main
from experiments.config import load_runs
from experiments.theme import save
from experiments.work_precision import report
from experiments.work_precision.cases import case
from experiments.work_precision.measure import (
    MG,
    ONSET,
    C,
    Course,
    Estimate,
    Native,
    Outcome,
    Point,
    Recorded,
    Reference,
    Variant,
    differences,
    pareto_front,
    quasi_random,
    smoothed_gradient,
    variants,
)
from experiments.work_precision.report import cheapest, fastest, samples_for

STDDEV = 0.3


def point(timestep, error, cost):
    return Point(Variant(MG), timestep, error, (cost, cost, cost))


def estimate(name, bias, variance, cost, num_samples=100):
    return Estimate(name, num_samples, 0.002, np.hypot(bias, variance**0.5), bias, 0.0, variance, (cost,))


def test_the_front_holds_what_no_other_beats_in_both():
    costs, errors = [1.0, 2.0, 3.0, 2.0, 4.0], [0.5, 0.2, 0.3, 0.2, np.inf]
    # The third costs more than the second and errs more; the last is no number; equal ones both stand.
    assert pareto_front(costs, errors).tolist() == [True, True, False, True, False]


def test_a_coarse_step_that_is_right_by_luck_is_not_recommended():
    found = [point(1e-3, 0.01, 4.0), point(2e-3, 0.04, 2.0), point(4e-3, 0.2, 1.0), point(8e-3, 0.03, 0.5)]
    chosen = fastest(found, 0.05)
    assert chosen is not None
    assert chosen.timestep == 2e-3


def test_an_estimate_needs_its_variance_over_what_bias_leaves_of_the_target():
    # Target² = bias² + V/N: 0.05² − 0.03² = 0.04², so N = 0.64/0.0016 = 400 with V = 0.64 per sample.
    assert samples_for(estimate("first order", 0.03, 0.64 / 100, 1.0), 0.05) == pytest.approx(400, abs=1)
    assert samples_for(estimate("first order", 0.06, 0.64 / 100, 1.0), 0.05) == np.inf


def test_the_cheapest_gradient_is_the_one_whose_rollouts_take_least_time_together():
    few_dear = estimate("first order, onset", 0.0, 0.01 / 100, 4.0)  # 4 samples suffice: 0.16 s
    many_cheap = estimate("zeroth order", 0.0, 4.0 / 100, 1.0)  # 1600 samples: 16 s
    biased = estimate("first order, discrete", 0.2, 0.0, 0.1)
    choice = cheapest([many_cheap, few_dear, biased], 0.05)
    assert choice is not None
    assert choice.estimate is few_dear
    assert choice.seconds == pytest.approx(4.0 * 4 / 100)


def test_a_scene_on_which_everything_diverges_is_drawn_and_gets_no_recommendation(tmp_path):
    lost = replace(estimate("first order, onset", np.inf, np.inf, 1.0), error=np.inf)
    references, compiling = {name: Reference(1e-4, 2e-4) for name in (MG, C)}, {"mg.step": 1.0, "mjx.step": 2.0}
    points = (point(1e-3, np.inf, 4.0), point(2e-3, np.inf, 2.0))
    course = Course("x", "X", 2e-3, points, references, (lost,), 0.01, compiling)
    outcome = Outcome(load_runs("work_precision", [])[0].settings, (course,))
    assert len(save(report.drawings(outcome), tmp_path)) == 2
    ((_, known_to, _, motion, costs, gradient, *_),) = report.tables(outcome)[0].rows
    assert (known_to, motion, costs, gradient) == ("0.01%", "–", "–; –; –", "–")


def test_the_smoothed_gradient_sees_a_jump():
    """A Heaviside step at 0.1 in the first parameter: its smoothed slope is the density there, and none in the second."""
    noise = STDDEV * quasi_random(4096, 2, 1)
    value, error = smoothed_gradient((noise[:, 0] > 0.1).astype(float), noise, STDDEV)
    exact = np.array([norm.pdf(0.1, scale=STDDEV), 0.0])
    # Eight scrambles give the error bar: five of them, for Student's t with seven degrees of freedom has wide tails.
    assert (np.abs(value - exact) < 5 * error).all()
    assert (error < 0.02 * exact[0]).all()


@pytest.fixture(scope="module")
def records():
    """f(w) = exp(w₁) − w₂/2, whose mean has the gradient (exp(σ²/2), −1/2)."""
    noise = jnp.asarray(STDDEV * quasi_random(512, 2, 2))
    costs = jnp.exp(noise[:, 0]) - 0.5 * noise[:, 1]
    gradients = jnp.stack([jnp.exp(noise[:, 0]), jnp.full(512, -0.5)], axis=1)
    return Recorded(costs=costs, gradients=gradients, noise=noise, stddev=jnp.full(2, STDDEV), dim=2)


@pytest.mark.parametrize("name", ["first_order", "zeroth_order"])
def test_estimators_take_records_for_rollouts(records, key, name):
    found = jax.jit(lambda k: getattr(mg.estimators, name)(records, jnp.zeros(2), k, num_samples=256))(key)
    exact = np.array([np.exp(STDDEV**2 / 2), -0.5])
    # Four standard errors of the estimate, and the records' own distance from their density, below 1e-3.
    assert (np.abs(found.value - exact) < 4 * np.asarray(found.standard_error) + 1e-3).all()


def test_the_threaded_rollout_ends_where_single_steps_do():
    one = case("arm")
    qvel = one.start[1] + np.array([[0.0], [0.2]]) @ one.directions[:1]
    ends, seconds = Native(one, Variant(C, "implicitfast")).timed(qvel, 0.004, 1e-10)
    model = one.model
    model.opt.integrator, model.opt.tolerance = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 1e-10
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = one.start[0], qvel[1], one.controls
    mujoco.mj_step(model, data, 40)  # of 4 ms, in 0.16 s
    assert ends[0][1] == pytest.approx(data.qpos, abs=1e-10)
    assert ends[1][1] == pytest.approx(data.qvel, abs=1e-9)
    assert seconds > 0


def test_distances_of_free_bodies_are_metres_and_radians():
    model = case("bounce").model
    here = np.array([[0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]])
    turned = np.array([[0.3, 0.0, 0.1, np.cos(0.2), 0.0, 0.0, np.sin(0.2)]])
    still = np.zeros((1, 6))
    found = differences(model, (here, still), (turned, still))
    assert found[0] == pytest.approx([0.3, 0, 0, 0, 0, 0.4], abs=1e-12)


def test_an_onset_is_compiled_where_there_is_a_contact():
    assert {name: Variant(ONSET) in variants(case(name)) for name in ("pendulum", "push", "bounce")} == {
        "pendulum": False, "push": True, "bounce": True,
    }  # fmt: skip


@pytest.mark.parametrize("size", ["quick", "default", "full"])
def test_every_time_step_divides_every_motion(size):
    sizes = load_runs("work_precision", [f"size={size}"])[0].settings.sizes
    for name in sizes.scenes:
        one = case(name)
        for refinement in (*sizes.refinements, *sizes.gradient_refinements):
            steps = one.duration * refinement / one.model.opt.timestep
            assert steps == pytest.approx(round(steps), abs=1e-9), (name, refinement)


@pytest.mark.slow
def test_a_run_leaves_its_diagrams_its_table_and_a_recommendation(tmp_path):
    settings = ["size='quick'", "scenes=['bounce']"]
    assert main(["run", "work_precision", *settings, "--output", str(tmp_path)]) == 0
    folder = tmp_path / "work_precision"
    with (folder / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["of"] == "motion" and row["integrator"] == "Euler"]
    # Both engines find the same motion, whatever it costs; the spread of single precision is beside it.
    found = {(row["library"], row["precision"], row["timestep"]): float(row["error"]) for row in rows}
    in_double = {step: error for (library, kind, step), error in found.items() if (library, kind) == (MG, "float64")}
    assert in_double == pytest.approx({step: found[C, "float64", step] for step in in_double}, rel=1e-5)
    assert in_double == pytest.approx({step: found["mjx.step", "float32", step] for step in in_double}, rel=0.05)
    answer = json.loads((folder / "summary.json").read_text())["verdict"]
    assert answer.startswith("For 5% error of the motion mg.step takes")
