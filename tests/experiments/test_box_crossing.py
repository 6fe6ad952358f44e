"""The box crossing beside C MuJoCo in a loop and the published starts, and its report on descents with known numbers."""

import mujoco
import numpy as np
import pytest

from experiments.box_crossing import Method, Outcome, Settings, answer, drawings, tables, verdict
from experiments.problems import box_crossing as problem
from experiments.problems.box_crossing import Descent, box_crossing, descend
from experiments.theme import save


@pytest.fixture(scope="module")
def capsules():
    return box_crossing("capsule")


def test_the_loss_is_that_of_a_loop_over_mujocos_steps():
    task = box_crossing()
    model, params = task.scene.to_mujoco(), np.asarray(task.start(7))
    data, knots, total = mujoco.MjData(model), params.reshape(10, 3), 0.0
    for i in range(1200):
        # Ten knots over 1200 rows of controls; the path has 13 points over 6 s, and step i ends at (i + 1) times 5 ms.
        data.ctrl[:] = [np.interp(9 * i / 1199, np.arange(10), along) for along in knots.T]
        mujoco.mj_step(model, data)
        path = [np.interp(0.005 * (i + 1), 0.5 * np.arange(13), along) for along in problem.PATH]
        total += np.sum((data.qpos[:2] - path) ** 2) / 1200
    # Rounding grows where a wheel leaves an edge; a path late by one step would change the loss by 2e-3.
    assert float(task.loss(task.start(7))) == pytest.approx(total, rel=1e-4)


@pytest.mark.parametrize(("seed", "published"), [(42, 1.4771), (43, 1.1970), (44, 1.7449)])
def test_the_published_starts_lose_what_the_published_mjx_loses(capsules, seed, published):
    # Its first losses, of results/mjx.json; the path is read off to the centimetre from a replay that is 9 cm off.
    assert float(capsules.loss(capsules.start(seed))) == pytest.approx(published, rel=0.05)


def test_a_step_of_least_squares_on_capsules_beats_the_published_loss(capsules):
    assert descend(capsules, "least_squares", 1).loss[-1] < 0.074


def test_what_capsules_find_holds_on_cylinders(capsules):
    assert float(box_crossing().loss(descend(capsules, "least_squares", 6).params)) < 0.074


def test_cylinders_have_derivatives_whatever_the_tolerance_of_their_contacts():
    """Derivatives search for contacts to the end; by the tolerance of the motion they were beyond 1e6."""
    norms = [descend(box_crossing(ccd_tolerance=x), "first_order", 1).gradient_norm[0] for x in (1e-14, 1e-6)]
    assert max(norms) < 1


def descents(seconds, losses, norm=1.0):
    return [Descent(np.array(seconds), np.array(losses), np.full(len(losses), norm), np.zeros(30), 2.0)]


@pytest.fixture
def outcome():
    runs = {
        "a": descents([1, 3, 30], [0.2, 0.07, 0.0]),
        "b": descents([1, 2, 3], [np.nan, 0.05, 0.5]),
        "c": descents([1, 20], [1.0, 0.01], np.inf),
    }
    methods = tuple(Method(label=label, method="first_order", num_steps=2) for label in runs)
    given = {"experiment": "box_crossing", "sizes": {"num_starts": 1, "num_methods": 3}, "methods": methods}
    settings = Settings.model_validate(given)
    return Outcome(settings, runs, mujoco.MjModel.from_xml_string("<mujoco/>"), np.zeros((2, 0)))


def test_who_reaches_the_loss_is_told_by_seconds_and_not_after_the_time_is_over(outcome, tmp_path):
    assert [outcome.found(label)[0, 0] for label in "abc"] == [3.0, 2.0, np.inf]
    assert [outcome.found(label)[0, 1] for label in "abc"] == [0.07, 0.05, 1.0]
    assert answer(outcome).startswith("B: 2.0 s at worst")
    assert verdict(outcome).endswith("from every start: “a” (3.0 s) and “b” (2.0 s).")
    assert [row[1] for row in tables(outcome)[0].rows[:3]] == ["3", "2", "–"]
    assert len(save(drawings(outcome), tmp_path)) == 1
    assert len(outcome.rows()) == 8
