"""The summary tells a human what there is."""

import pytest

from mjxgrad.contact import Softness
from mjxgrad.scene import load_scene

BALL_WALL = """
<mujoco>
  <option timestep="0.002"><flag energy="enable"/></option>
  <worldbody>
    <light/>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <geom name="wall" type="box" pos=".6 0 .1" size=".01 .2 .1" margin="0.005"/>
    <body name="ball" pos="0 0 1"><freejoint/><geom name="ball" size=".02"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def scene():
    return load_scene(BALL_WALL)


def _line(text, start):
    return next(line.split() for line in text.splitlines() if line.strip().startswith(start))


def test_sizes_and_options_are_shown(scene):
    first, sizes, options = scene.summary().splitlines()[:3]
    assert first == "the MJCF"
    assert sizes.strip() == "1 body, 6 degrees of freedom, 3 geoms"
    for part in ("time step 2 ms", "Euler", "pyramidal cones", "float64"):
        assert part in options


@pytest.mark.parametrize("solver", ["CG", "Newton"])
def test_what_c_mujoco_steps_has_the_options_of_its_file(solver):
    """MJX's model of such a scene has places and numbers alone."""
    text = BALL_WALL.replace(
        "<option ", f'<option integrator="implicit" cone="elliptic" solver="{solver}" iterations="7" '
    )
    options = load_scene(text, engine="mujoco").summary().splitlines()[2]
    for part in ("Implicit,", "elliptic cones", f"{solver} to", "in 7 iterations"):
        assert part in options


def test_effective_contact_parameters_are_shown_for_each_pair(scene):
    # solref 0.02 1: k = 1/0.02² = 2500, b = 2/0.02 = 100, h²k + 2hb = 0.01 + 0.4.
    common = ["3", "0.02", "1", "2500", "100", "1", "0.9–0.95", "1", "0.41", "1"]
    assert _line(scene.summary(), "floor – ball") == ["floor", "–", "ball", *common, "0"]
    assert _line(scene.summary(), "ball – wall") == ["ball", "–", "wall", *common, "5"]


def test_softness_is_shown_as_it_acts(scene):
    soft = scene.with_softness(Softness(stiffness=1e4, damping_ratio=0.5, impedance=0.5))
    condim, stiffness, *others = _line(soft.summary(), "floor – ball")[3:7]
    assert (condim, float(stiffness), others) == ("3", -1e4, ["-100", "10000"])


def test_conversions_omissions_and_reasons_are_shown(scene):
    text = scene.summary()
    for entry in (*scene.conversions, *scene.omissions):
        assert entry.what in text
        assert entry.reason in text


def test_what_rollouts_leave_out_is_shown_by_the_engine(scene):
    """The ball has 7 positions, 6 velocities and as many accelerations; time is one number more.

    Of 2 contacts × 6 velocities none moves both sides or neither.
    """
    by_mjx, by_c = scene.summary(), scene.with_engine("mujoco").summary()
    assert "a rollout carries 20 of" in by_mjx
    assert "lights" in by_mjx
    assert "columns of contacts" not in by_mjx
    assert "derivatives are those of the solution" in by_c
    assert "a rollout carries" not in by_c


def test_zero_columns_of_contacts_are_counted():
    """A ball and a pendulum over a floor: 6, 1 and 6 + 1 of 7 columns move the floor and each, and each other."""
    ball = "<body pos='0 0 1'><freejoint/><geom size='.1'/></body>"
    pendulum = "<body pos='2 0 1'><joint/><geom pos='.3 0 0' size='.1'/></body>"
    floor = "<geom type='plane' size='1 1 1'/>"
    text = load_scene(f"<mujoco><worldbody>{floor}{ball}{pendulum}</worldbody></mujoco>").summary()
    assert "7 of 21: these joints" in text


def test_nothing_of_runge_kutta_derivatives_is_left_out():
    rk4 = load_scene(BALL_WALL.replace("<option ", "<option integrator='RK4' ")).with_engine("mujoco").summary()
    assert "derivatives are those of the solution" not in rk4


def test_warnings_are_shown(scene):
    with pytest.warns(UserWarning, match="stable below 4"):
        stiff = scene.with_softness(Softness(stiffness=1e8, damping_ratio=1))
    assert "Warnings" in stiff.summary()
    assert "Warnings" not in scene.summary()


def test_equal_pairs_share_a_line():
    balls = "".join(f"<body pos='{i} 0 1'><freejoint/><geom size='.1'/></body>" for i in range(9))
    text = load_scene(f"<mujoco><worldbody>{balls}</worldbody></mujoco>").summary()
    assert "36 pairs of geoms can touch" in text
    assert "+ 35 more" in text
