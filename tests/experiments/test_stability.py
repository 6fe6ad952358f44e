"""The grid reaches what it is to reach, and what is said of it follows from its numbers."""

from concurrent.futures import ThreadPoolExecutor

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import pytest
import xarray as xr

from experiments.config import load_runs
from experiments.stability.classes import Derivative, Motion, MotionRecord, classify_derivative, classify_motion
from experiments.stability.measure import C_MUJOCO, Outcome, SceneOutcome
from experiments.stability.report import UNEXPLAINED, drawings, findings, load, reasons
from experiments.stability.scenes import DEFAULTS, FIELDS, PLANES, Points, catalogue, configure, points
from experiments.stability.simulators import Steps, errors_of_solves, simulate, unbalanced

SCENES = {scene.name: scene for scene in catalogue()}


def _points(count=1, **values):
    given = DEFAULTS | values
    return Points(
        {name: np.broadcast_to(np.asarray(value, float), count).copy() for name, value in given.items()},
        np.full(count, -1),
        (),
    )


def _simulate(grid, num_steps):
    with ThreadPoolExecutor(1) as pool:
        return simulate(SCENES["ball"], grid, num_steps, pool).course


@pytest.mark.parametrize("size", ["quick", "default", "full"])
def test_every_size_names_scenes_that_there_are(size):
    sizes = load_runs("stability", [f"size={size}"])[0].settings.sizes
    assert set(sizes.scenes or SCENES) <= set(SCENES)
    assert set(sizes.event or SCENES) <= set(SCENES)


def test_the_grid_reaches_its_corners_and_coincident_centres():
    found = points(SCENES["two balls, pyramidal"], 12, 256, 0)
    low_high = {"mass_ratio": (1e-6, 1e6), "speed": (1e-2, 100.0), "timestep": (1e-4, 5e-2), "margin": (0.0, 0.02)}
    for name, (low, high) in low_high.items():
        assert found.values[name].min() == pytest.approx(low)
        assert found.values[name].max() == pytest.approx(high)
    start, _ = SCENES["two balls, pyramidal"].start(found[int(np.argmax(found.values["depth"] == 2.0))])
    np.testing.assert_array_equal(start[:3], start[7:10])


@pytest.mark.parametrize("resolution", [8, 12, 24])
def test_depths_of_two_radii_are_met_at_every_resolution(resolution):
    found = points(SCENES["two balls, pyramidal"], resolution, 4, 0)
    plane = [names[:2] for names in PLANES["two balls"]].index(("time_constant", "depth"))
    assert (found.values["depth"][found.family == plane] == 2.0).any()


def test_masses_come_with_all_that_mujoco_derives_from_them():
    scene = SCENES["two balls, pyramidal"]
    model = scene.model()
    configure(scene, model, mujoco.MjData(model), DEFAULTS | {"mass_ratio": 1e3})
    np.testing.assert_allclose(model.body_mass[1:], [1.0, 1e3])
    np.testing.assert_allclose(model.body_invweight0[1:, 0], [1.0, 1e-3])
    # 2/5 m r² of a ball of 50 mm
    np.testing.assert_allclose(model.body_inertia[1:, 0], [1e-3, 1.0])


def test_the_load_is_that_of_the_closed_form_and_knows_refsafe():
    grid = _points(2, timestep=[0.01, 0.05], time_constant=0.02, damping_ratio=0.3)
    limit = 2 * 0.3 * (np.sqrt(1.09) - 0.3)
    np.testing.assert_allclose(load(SCENES["ball"], grid), np.array([0.5, 2.5]) / limit)
    # refsafe keeps h/tc at one half
    np.testing.assert_allclose(load(SCENES["ball, refsafe"], grid), 0.5 / limit)


def test_c_mujoco_bounces_with_the_restitution_of_the_closed_form():
    grid = _points(timestep=1e-4, time_constant=1e-3, impedance_first=0.9, impedance_last=0.9)
    course = _simulate(grid, 100)
    # e⁻² at critical damping; the time step is a tenth of the time constant
    assert course.qvel[0, 0] == pytest.approx(np.exp(-2), abs=0.02)
    assert course.residual[0] < 1e-9
    assert course.kinetic[0, 0] == pytest.approx(0.5)


def test_a_start_that_is_not_finite_is_bad_from_its_first_step():
    course = _simulate(_points(stiffness=1e300), 20)
    assert 0 <= course.first_bad_step[0] < 20
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
    configure(scene, model, data, grid[0])
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
    motions = [Motion.SETTLES, Motion.BOUNCES_RIGHT, Motion.DIVERGES]
    one = _outcome("ball", _points(3), motions, [Motion.MOVES, Motion.MOVES, Motion.DIVERGES], [1.0, 1.0, 1.0])
    assert reasons(one, "float64") == {}


@pytest.mark.parametrize(("count", "said"), [(0, "none"), (1, "1"), (2, "2")])
def test_what_gains_energy_is_counted_on_either_side_of_the_explicit_limit(count, said):
    """h/tc < 2ζ(√(1+ζ²) − ζ), 0.83 of critical damping: 0.1 and 0.5 are within, 2.5 is beyond."""
    grid = _points(3, timestep=[0.002, 0.01, 0.05], time_constant=0.02, damping_ratio=1.0)
    motions = [Motion.GAINS_ENERGY] * count + [Motion.BOUNCES_RIGHT] * (2 - count) + [Motion.GAINS_ENERGY]
    one = _outcome("ball", grid, motions, motions, [0.0, 0.0, 0.0])
    settings = load_runs("stability", ['precisions=["float64"]'])[0].settings
    sentence = findings(Outcome(settings, [one]))[0]
    assert f"Within the explicit limit {said} of 2 single bounces gain energy" in sentence
    assert "beyond it 1 of 1 do" in sentence


def test_what_no_reason_fits_stays_unexplained():
    one = _outcome("ball", _points(2), [Motion.GAINS_ENERGY] * 2, [Motion.MOVES] * 2, [1.0, 1e-6])
    found = reasons(one, "float64")
    assert found[0] == UNEXPLAINED
    assert "same motion" in found[1]


def test_other_impedances_at_no_width_are_told_apart():
    grid = _points(2, width=0.0, impedance_last=[0.9, 0.95])
    one = _outcome("ball", grid, [Motion.GAINS_ENERGY] * 2, [Motion.MOVES] * 2, [1.0, 1.0])
    assert reasons(one, "float64")[0] == UNEXPLAINED
    assert "width 0" in reasons(one, "float64")[1]


def test_balls_that_part_from_one_point_and_motions_that_explode_are_told_apart():
    worse = [Motion.TUNNELS] * 2, [Motion.MOVES] * 2, [1.0, 1.0]
    found = reasons(_outcome("stack", _points(2, depth=[1.9, 2.0]), *worse), "float64")
    assert found[0] == UNEXPLAINED
    assert "centres coincide" in found[1]
    assert reasons(_outcome("box, pyramidal", _points(2, depth=2.0), *worse), "float64")[0] == UNEXPLAINED
    found = reasons(_outcome("box, pyramidal", _points(2), *worse, Derivative.EXPLODES), "float64")
    assert "explodes" in found[0]


def test_a_square_is_pale_where_the_motion_is_as_in_c_mujoco_and_an_axis_has_three_numbers():
    """Of the first plane the first point differs, in the lower left corner."""
    grid = points(SCENES["ball"], 8, 4, 0)
    theirs = [Motion.MOVES] * len(grid)
    one = _outcome("ball", grid, [Motion.TUNNELS, *theirs[1:]], theirs, np.zeros(len(grid)))
    found = Outcome(load_runs("stability", ['precisions=["float64"]'])[0].settings, [one])
    picture, *_ = drawings(found)["ball"](found)
    in_c, in_mjxgrad, slope = (axis.images[0].get_array()[..., 3] for axis in picture.axes[:3])
    assert (in_c == 1).all()
    assert (slope == 1).all()
    assert in_mjxgrad[0, 0] == 1
    assert (in_mjxgrad.ravel()[1:] < 0.5).all()
    assert {len(ticks) for axis in picture.axes for ticks in (axis.get_xticks(), axis.get_yticks())} == {3}
    plt.close(picture)


def test_a_workspace_notes_what_a_scene_s_time_step_does_not_follow(tmp_path):
    import mjxgrad as mg
    from experiments.workspace import Workspace

    workspace = Workspace(tmp_path)
    scene = SCENES["ball, refsafe"].model()
    workspace.check(mg.load_scene(scene))
    assert workspace.warnings == []
    scene.opt.timestep = 0.05
    with pytest.warns(UserWarning, match="refsafe"):
        loaded = mg.load_scene(scene)
    workspace.check(loaded)
    assert any("refsafe replaces it by 0.1 s" in text for text in workspace.warnings)
    assert all(text.startswith("ball: ") for text in workspace.warnings), (
        "a reader of several scenes' has to know which"
    )


def _record(**changes):
    fine = {
        "is_sound": True, "residual": 1e-9, "gain": 0.9, "rest": 0.5, "has_crossed": False,
        "restitution": np.nan, "expected": np.nan,
    }  # fmt: skip
    return MotionRecord(**{name: np.array([value]) for name, value in (fine | changes).items()})


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, Motion.MOVES),
        ({"rest": 1e-4}, Motion.SETTLES),
        # e⁻² is the restitution at critical damping.
        ({"restitution": 0.14, "expected": np.exp(-2)}, Motion.BOUNCES_RIGHT),
        ({"restitution": 0.30, "expected": np.exp(-2)}, Motion.BOUNCES_OTHERWISE),
        ({"gain": 1.2, "restitution": 1.1, "expected": 1.1}, Motion.GAINS_ENERGY),
        ({"gain": np.nan}, Motion.GAINS_ENERGY),
        ({"has_crossed": True, "gain": 2.0}, Motion.TUNNELS),
        ({"residual": 0.5, "has_crossed": True}, Motion.UNSOLVED),
        ({"residual": np.nan}, Motion.UNSOLVED),
        ({"is_sound": False, "residual": np.nan, "gain": np.inf}, Motion.DIVERGES),
    ],
)
def test_a_motion_is_called_by_the_worst_of_what_it_did(changes, expected):
    assert classify_motion(_record(**changes))[0] == expected


@pytest.mark.parametrize(
    ("derivative", "is_finite", "is_sound", "error", "expected"),
    [
        (-np.exp(-2), True, True, 0.0, Derivative.RIGHT),
        (-3.0, True, True, 0.0, Derivative.WRONG),
        (-3.0, True, True, 1.0, Derivative.UNJUDGED),
        (1e9, True, True, 0.0, Derivative.EXPLODES),
        (-np.exp(-2), False, True, 0.0, Derivative.NON_FINITE),
        (np.inf, True, True, 0.0, Derivative.NON_FINITE),
        (-np.exp(-2), True, False, 0.0, Derivative.NONE),
    ],
)
def test_a_derivative_is_held_against_the_restitution(derivative, is_finite, is_sound, error, expected):
    found = classify_derivative(
        np.array([derivative]),
        np.array([is_finite]),
        np.array([is_sound]),
        np.array([-np.exp(-2)]),
        np.array([error]),
        largest=1e4,
        tolerance=1e-3,
    )
    assert found[0] == expected
