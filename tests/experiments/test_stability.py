"""The grid reaches what it is to reach, and what is said of it follows from its numbers."""

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import pytest
import xarray as xr

import mjxgrad as mg
from experiments.config import load_runs
from experiments.stability.measure import (
    C_MUJOCO,
    Course,
    Derivative,
    Motion,
    Outcome,
    SceneOutcome,
    Steps,
    classify_derivative,
    classify_motion,
    errors_of_solves,
    in_c_mujoco,
    unbalanced,
)
from experiments.stability.report import drawings, reasons
from experiments.stability.scenes import DEFAULTS, FIELDS, Points, catalogue, points
from experiments.workspace import Workspace

SCENES = {scene.name: scene for scene in catalogue()}


def _points(count=1, **values):
    given = DEFAULTS | values
    return Points(
        {name: np.broadcast_to(np.asarray(value, float), count).copy() for name, value in given.items()},
        np.full(count, -1),
        (),
    )


@pytest.mark.parametrize("size", ["quick", "default", "full"])
def test_every_size_names_scenes_that_there_are(size):
    sizes = load_runs("stability", [f"size={size}"])[0].settings.sizes
    assert set(sizes.scenes or SCENES) <= set(SCENES)


def test_the_grid_reaches_its_corners_and_coincident_centres():
    found = points(SCENES["two balls, pyramidal"], 12, 256, 0)
    low_high = {"mass_ratio": (1e-6, 1e6), "speed": (1e-2, 100.0), "timestep": (1e-4, 5e-2), "margin": (0.0, 0.02)}
    for name, (low, high) in low_high.items():
        assert found.values[name].min() == pytest.approx(low)
        assert found.values[name].max() == pytest.approx(high)
    start, _ = SCENES["two balls, pyramidal"].start(found[int(np.argmax(found.values["depth"] == 2.0))])
    np.testing.assert_array_equal(start[:3], start[7:10])


def test_c_mujoco_bounces_with_the_restitution_of_the_closed_form():
    """e⁻² at critical damping, 0.018 of the energy; the time step is a tenth of the time constant."""
    grid = _points(timestep=1e-4, time_constant=1e-3, impedance_first=0.9, impedance_last=0.9)
    course = in_c_mujoco(SCENES["ball"], grid, 100)
    assert np.sqrt(2 * course.kinetic[0, -1]) == pytest.approx(np.exp(-2), abs=0.02)
    assert course.residual[0] < 1e-9
    assert course.kinetic[0, 0] == pytest.approx(0.5)


def test_what_is_not_finite_is_not_sound_and_ends_at_its_last_good_state():
    course = in_c_mujoco(SCENES["ball"], _points(stiffness=1e300), 20)
    assert not course.is_sound[0]
    assert np.isfinite(course.qpos).all()


def test_unbalanced_is_the_share_of_the_velocity_that_a_solve_misses():
    # 3 N too much on 2 kg for 0.1 s, beside a speed of 1 m/s: 0.15 m/s of 1 + 0.1·(2·2 + 1 + 0)/2 m/s
    found = unbalanced(np.array([[2.0]]), np.array([2.0]), np.array([1.0]), np.array([1.0]), np.array([0.0]), 0.1)
    assert found == pytest.approx(0.15 / 1.25)


def test_a_solve_is_judged_by_the_forces_of_its_state_and_not_by_those_it_reports():
    """A ball on its way through contact: the acceleration of C MuJoCo has no error, one that is off by 2 % of a step has."""
    scene, grid = SCENES["ball"], _points(timestep=1e-3)
    model = scene.model()
    data = mujoco.MjData(model)
    scene.configure(model, data, grid[0])
    data.qpos[:], data.qvel[:] = -1e-3, -1.0
    mujoco.mj_forward(model, data)
    fields = {name: np.array(getattr(model, name))[None] for name in FIELDS} | {"timestep": np.array([1e-3])}
    off = data.qacc + 0.02 * 1.0 / 1e-3
    # Out of balance as it seems.
    steps = Steps(np.full((1, 2, 1), -1e-3), np.full((1, 2, 1), -1.0), np.array([[data.qacc, off]]), np.ones((1, 2)))
    right, wrong = errors_of_solves(scene, fields, steps, chunk=256)[0]
    moved = 1.0 + 1e-3 * (abs(off[0]) + abs(data.qacc[0]))  # gravity is off in this scene
    assert right < 1e-9
    assert wrong == pytest.approx(0.02 / moved, rel=1e-6)


def _outcome(scene, grid, ours, theirs, apart, derivative=Derivative.RIGHT):
    found = {
        "motion": [theirs, ours],
        "derivative": [[derivative] * len(grid)] * 2,
        "apart_from_c": [np.zeros(len(grid)), apart],
    }
    arrays = {key: (("simulator", "point"), np.array(values)) for key, values in found.items()}
    return SceneOutcome(SCENES[scene], grid, xr.Dataset(arrays, {"simulator": [C_MUJOCO, "float64"]}))


def test_only_what_is_worse_than_c_mujoco_needs_a_reason():
    theirs = [Motion.MOVES_ON, Motion.MOVES_ON, Motion.DIVERGES]
    one = _outcome("ball", _points(3), [Motion.SETTLES, Motion.MOVES_ON, Motion.DIVERGES], theirs, [1.0, 1.0, 1.0])
    assert reasons(one, "float64") == {}


@pytest.mark.parametrize(
    ("scene", "values", "apart", "words"),
    [
        ("ball", {}, 1.0, "unexplained"),
        ("ball", {}, 1e-6, "same motion"),
        ("ball", {"width": 0.0, "impedance_last": 0.9}, 1.0, "unexplained"),
        ("ball", {"width": 0.0, "impedance_last": 0.95}, 1.0, "width 0"),
        ("stack", {"depth": 1.9}, 1.0, "unexplained"),
        ("stack", {"depth": 2.0}, 1.0, "centres coincide"),
        ("box, pyramidal", {"depth": 2.0}, 1.0, "unexplained"),
        ("ball", {"timestep": 0.05, "time_constant": 0.02}, 1.0, "explicit limit"),
    ],
)
def test_what_is_worse_than_c_mujoco_has_a_reason_or_none(scene, values, apart, words):
    one = _outcome(scene, _points(1, **values), [Motion.GAINS_ENERGY], [Motion.MOVES_ON], [apart])
    assert words in reasons(one, "float64")[0]


def test_a_square_is_pale_where_the_motion_is_as_in_c_mujoco_and_an_axis_has_three_numbers():
    """Of the first plane the first point differs, in the lower left corner."""
    grid = points(SCENES["ball"], 8, 4, 0)
    theirs = [Motion.MOVES_ON] * len(grid)
    one = _outcome("ball", grid, [Motion.TUNNELS, *theirs[1:]], theirs, np.zeros(len(grid)))
    found = Outcome(load_runs("stability", ['precisions=["float64"]'])[0].settings, [one])
    picture, *_ = drawings(found)["ball"]
    in_c, in_mjxgrad, slope = (axis.images[0].get_array()[..., 3] for axis in picture.axes[:3])
    assert (in_c == 1).all()
    assert (slope == 1).all()
    assert in_mjxgrad[0, 0] == 1
    assert (in_mjxgrad.ravel()[1:] < 0.5).all()
    assert {len(ticks) for axis in picture.axes for ticks in (axis.get_xticks(), axis.get_yticks())} == {3}
    plt.close(picture)


def test_a_workspace_notes_what_a_scene_s_time_step_does_not_follow(tmp_path):
    """And names the scene: a reader of several has to know which."""
    scene, workspace = SCENES["ball, refsafe"].model(), Workspace(tmp_path)
    scene.opt.timestep = 0.05
    with pytest.warns(UserWarning, match="refsafe"):
        loaded = mg.load_scene(scene)
    workspace.check(loaded)
    assert any("ball: " in text and "refsafe replaces it by 0.1 s" in text for text in workspace.warnings)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, Motion.MOVES_ON),
        ({"rest": 1e-4}, Motion.SETTLES),
        ({"gain": 1.2, "rest": 1e-4}, Motion.GAINS_ENERGY),
        ({"gain": np.nan}, Motion.GAINS_ENERGY),
        ({"has_crossed": True, "gain": 2.0}, Motion.TUNNELS),
        ({"residual": 0.5, "has_crossed": True}, Motion.NOT_SOLVED),
        ({"residual": np.nan}, Motion.NOT_SOLVED),
        ({"is_sound": False, "residual": np.nan, "gain": np.inf}, Motion.DIVERGES),
    ],
)
def test_a_motion_is_called_by_the_worst_of_what_it_did(changes, expected):
    fine = {"is_sound": True, "residual": 1e-9, "gain": 0.9, "rest": 0.5, "has_crossed": False}
    sound, residual, *others = (np.array([value]) for value in (fine | changes).values())
    nothing = np.zeros((1, 1))
    assert classify_motion(Course(nothing, nothing, nothing, residual, sound), *others)[0] == expected


@pytest.mark.parametrize(
    ("derivative", "is_finite", "is_sound", "error", "expected"),
    [
        (-0.1, True, True, 0.0, Derivative.RIGHT),
        (-3.0, True, True, 0.0, Derivative.WRONG),
        (-3.0, True, True, 1.0, Derivative.UNJUDGED),
        (1e9, True, True, 0.0, Derivative.EXPLODES),
        (-0.1, False, True, 0.0, Derivative.NOT_FINITE),
        (np.inf, True, True, 0.0, Derivative.NOT_FINITE),
        (-0.1, True, False, 0.0, Derivative.NONE),
    ],
)
def test_a_derivative_is_held_against_differences_of_two_widths(derivative, is_finite, is_sound, error, expected):
    given, truth = (np.array([one]) for one in (derivative, is_finite, is_sound)), np.array([[-0.1 + error], [-0.1]])
    assert classify_derivative(*given, truth, largest=1e4, tolerance=1e-3)[0] == expected
