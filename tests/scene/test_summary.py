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
