"""Bodies, paths and references of the experiment on artificial discontinuities, from closed forms and C MuJoCo; and a run."""

import json

import mujoco
import numpy as np
import pytest
from scipy.stats import norm

from experiments.__main__ import main
from experiments.artificial_discontinuity.measure import overlap_force, slopes_at
from experiments.artificial_discontinuity.shapes import PATHS, shape
from experiments.config import ConfigurationError, load_runs

DEPTH = 0.005


@pytest.fixture(scope="module")
def bodies():
    return {"box": shape("box"), "balls": shape("balls"), "points": shape(4)}


def held(body, pose):
    data = mujoco.MjData(body.scene.mj_model)
    data.qpos[:] = pose
    mujoco.mj_forward(body.scene.mj_model, data)
    return data


@pytest.mark.parametrize("path", ["slide", "roll", "corner"])
def test_the_lowest_point_of_every_body_has_the_depth_asked_for(bodies, path):
    for body in bodies.values():
        data = held(body, PATHS[path].poses(body, DEPTH, np.array([0.0]))[0])
        assert data.contact.dist.min() == pytest.approx(-DEPTH, abs=1e-9)


def test_the_overlap_force_of_upright_cubes_is_the_area_of_the_faces_inside(bodies):
    """Moved by 0.1 and 0.013 m and 5 mm deep: 0.1 × 0.187 below, 0.187 × 0.005 and 0.1 × 0.005 m² at the sides."""
    force = overlap_force(PATHS["slide"].poses(bodies["box"], DEPTH, np.array([0.1, 0.2001])))
    assert force[0] == pytest.approx([0.187 * 0.005, 0.1 * 0.005, 0.1 * 0.187], rel=1e-9)
    assert force[1] == pytest.approx([0, 0, 0])


def test_every_point_of_a_lattice_is_a_spring_of_its_own(bodies):
    """Half of 16 points are over the cube, each a spring of 2500 / 16 N/m."""
    data = held(bodies["points"], PATHS["slide"].poses(bodies["points"], DEPTH, np.array([0.1]))[0])
    assert data.ncon == 8
    # Within the coupling that impedance leaves: 8 points × 0.05 / 16, and the torque they share.
    assert data.qfrc_constraint[2] == pytest.approx(8 / 16 * 2500 * DEPTH, rel=0.05)


def test_across_a_step_first_order_says_nothing_and_the_rest_the_density():
    """A step of 2 under noise of 0.1 has the slope 2 φ(0) / 0.1."""

    def step(starts, _):
        return 2.0 * (starts > 0.5), np.zeros_like(starts)

    settings = load_runs("artificial_discontinuity", [])[0].settings
    found = slopes_at(settings, "step", "x", step, 0.5, 0.1, np.random.default_rng(0))
    exact = 2 * norm.pdf(0) / 0.1
    assert found.jump == pytest.approx(exact, rel=1e-3)  # the search divides 6 stddev by 3e5
    assert found.reference == pytest.approx(exact, abs=4 * found.reference_error)
    assert found.reference_error < 0.1 * found.errors[2]
    assert found.estimates[2] == pytest.approx(exact, abs=4 * found.errors[2])
    assert found.deviation[0] > 100


@pytest.mark.parametrize(
    ("override", "sentence"), [("depth=0.05", "depth"), ("size=small", "size"), ("threshold=2.0", "threshold")]
)
def test_settings_that_cannot_be_are_a_sentence(override, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        load_runs("artificial_discontinuity", [override])


@pytest.mark.slow
def test_a_quick_run_says_which_bodies_to_build_contact_of(tmp_path):
    assert main(["run", "artificial_discontinuity", "size=quick", "--output", str(tmp_path)]) == 0
    verdict = json.loads((tmp_path / "artificial_discontinuity" / "summary.json").read_text())["verdict"]
    assert "It does not with 8 balls at corners" in verdict
