"""The experiment on artificial discontinuities: its scenes, from closed forms, and slopes across a jump."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from experiments.artificial_discontinuity import CASES, MARGIN, PLAIN, ROUNDED, Settings, secant_slope

RADIUS = 0.01
SETTINGS = Settings(experiment="artificial_discontinuity", rounding=RADIUS)


def normal_of(remedy: str, x: float, z: float) -> np.ndarray:
    """Hold the tip at a place relative to the box's edge, x outwards and z upwards, in m; return the normal away from the box."""
    model = mujoco.MjModel.from_xml_string(CASES[0].mjcf(remedy, RADIUS))
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0.1 + x, 0.1 + z]
    mujoco.mj_forward(model, data)
    assert data.ncon == 1
    return data.contact.frame[0, [0, 2]] * (1 if data.contact.geom[0, 0] == 0 else -1)


@pytest.mark.parametrize("remedy", [ROUNDED, MARGIN])
@pytest.mark.parametrize(("x", "z"), [(-0.004, -0.003), (-0.003, -0.004), (-0.02, -0.005), (-0.001, -0.007)])
def test_the_normal_of_a_rounded_box_is_radial_about_its_edge(remedy, x, z):
    """The edge's centre of curvature lies a radius inside both faces; beside it the normal is the face's."""
    radial = np.maximum([x + RADIUS, z + RADIUS], 0)
    assert normal_of(remedy, x, z) == pytest.approx(radial / np.linalg.norm(radial), abs=1e-9)


def test_the_normal_of_a_box_flips_where_its_faces_are_equally_near():
    assert normal_of(PLAIN, -0.0041, -0.004) == pytest.approx([0, 1], abs=1e-9)
    assert normal_of(PLAIN, -0.0039, -0.004) == pytest.approx([1, 0], abs=1e-9)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.title)
def test_no_remedy_changes_where_contact_begins_away_from_edges(case):
    """The tip and the cube are let down on the middle of a face, the cylinder is let down level: force begins at one height."""
    deepest = []
    for remedy in (PLAIN, ROUNDED, MARGIN):
        model = mujoco.MjModel.from_xml_string(case.mjcf(remedy, RADIUS))
        data = mujoco.MjData(model)
        data.qpos[:] = {3: [0, 0, 0.1], 2: [0, 0.195]}[model.nq] if "cylinder" not in case.title else [0.028, 0]
        mujoco.mj_forward(model, data)
        deepest.append(np.min(data.contact.dist - data.contact.includemargin))
    assert deepest == pytest.approx([deepest[0]] * 3, abs=1e-9)
    assert deepest[0] < 0


def test_secants_see_the_jump_that_derivatives_miss():
    """A step of 2 in a slope of 3, noise of 0.1 about 0.05 beside it: 3 + 2 φ(0.5) / 0.1."""
    slopes = [secant_slope(lambda x: 3 * x + 2.0 * (x > 0.05), 0.0, 0.1, 512, seed) for seed in range(16)]
    error = np.std(slopes, ddof=1) / 4
    assert np.mean(slopes) == pytest.approx(3 + 2 * norm.pdf(0.5) / 0.1, abs=4 * error)
    assert error < 0.05


def test_a_tip_beside_the_edge_moves_the_same_by_both_engines():
    """Six steps: the tip has come into the box, and its normal is sideways."""
    case = CASES[0]
    ends = []
    for engine in ("mujoco", "mjx"):
        scene = mg.load_scene(case.mjcf(PLAIN, RADIUS)).with_engine(engine)
        start = mg.initial_state(scene, *case.start(jnp.asarray(-0.001)))
        ends.append(jax.jit(lambda start, scene=scene: mg.rollout(scene, start, horizon=6).final.qvel)(start))
    assert np.allclose(ends[0], ends[1], rtol=1e-6)
    assert ends[0][0] < -1e-3
