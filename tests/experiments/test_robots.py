"""What is measured of published robots, on one small scene of each kind that MJX lacks or does otherwise, by C's engine."""

import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from experiments import robots

_BALL = '<body pos="0 0 .12"><freejoint/><geom size=".1"/></body>'
_FLOOR = '<geom type="plane" size="5 5 .1"/>'
_SCENES = {
    "a gripper of boxes that holds a cylinder": """<mujoco><option gravity="0 0 0"/><default><joint type="slide" damping="5"/>
        <geom type="box" size=".02 .05 .05"/><position kp="500" ctrlrange="0 .02"/></default><worldbody>
        <body pos="-.0545 0 0"><joint name="left" axis="1 0 0"/><geom/></body>
        <body pos=".0545 0 0"><joint name="right" axis="-1 0 0"/><geom/></body>
        <body><freejoint/><geom type="cylinder" size=".035 .04" euler="0 0 10"/></body></worldbody>
        <actuator><position joint="left"/><position joint="right"/></actuator></mujoco>""",
    "ellipsoids that fall on each other": f"""<mujoco><worldbody>{_FLOOR}
        <body pos="0 0 .1"><freejoint/><geom type="ellipsoid" size=".1 .08 .06"/></body>
        <body pos=".01 0 .25"><freejoint/><geom type="ellipsoid" size=".05 .06 .07"/></body></worldbody></mujoco>""",
    "a slider-crank": """<mujoco><worldbody><site name="slider" euler="0 90 0" pos="-.5 0 0"/>
        <body><joint name="hinge" axis="0 1 0" damping=".1"/><geom type="capsule" fromto="0 0 0 0 0 .2" size=".02"/>
        <site name="crank" pos="0 0 .2"/></body></worldbody>
        <actuator><general cranksite="crank" slidersite="slider" cranklength=".6" gainprm="5"/></actuator></mujoco>""",
    "a muscle that pulls a tendon": """<mujoco><worldbody><site name="origin" pos="0 0 .3"/>
        <body><joint axis="0 1 0" damping=".1"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".02"/>
        <site name="insertion" pos=".2 0 0"/></body></worldbody>
        <tendon><spatial name="tendon" range=".1 .6"><site site="origin"/><site site="insertion"/></spatial></tendon>
        <actuator><muscle tendon="tendon" ctrlrange="0 1" lengthrange=".1 .6" force="50"/></actuator></mujoco>""",
    "a body that adheres": f"""<mujoco><worldbody>{_FLOOR}
        <body name="foot" pos="0 0 .12"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody>
        <actuator><adhesion body="foot" ctrlrange="0 1" gain="20"/></actuator></mujoco>""",
    "contact without slip": f"""<mujoco><option noslip_iterations="5" gravity="1 0 -9.81"/><worldbody>{_FLOOR}{_BALL}
        </worldbody></mujoco>""",
    "an implicit integrator and a fluid": """<mujoco><option integrator="implicit" density="1000" viscosity=".1"/><worldbody>
        <body><joint axis="0 1 0" damping="2"/><geom type="box" size=".02 .1 .2" pos="0 0 -.2"/></body></worldbody></mujoco>""",
    "elliptic cones that resist rolling": f"""<mujoco><option cone="elliptic"/><default><geom condim="6"/>
        </default><worldbody>{_FLOOR}{_BALL}</worldbody></mujoco>""",
    "a weld to a mocap body": """<mujoco><worldbody><body name="hand" mocap="true" pos="0 0 1"/>
        <body name="held" pos="0 .05 1"><freejoint/><geom size=".05"/></body></worldbody>
        <equality><weld body1="hand" body2="held"/></equality></mujoco>""",
    "a servo of a ball joint": """<mujoco><worldbody><body><joint name="ball" type="ball" damping=".5"/>
        <geom type="capsule" fromto="0 0 0 .1 0 -.3" size=".03"/></body></worldbody>
        <actuator><position joint="ball" gear="1 0 0" kp="5"/><position joint="ball" gear="0 1 0" kp="5"/></actuator></mujoco>""",
}

# Whose like tests/engines steps, and collisions of ellipsoids, which are searched for as the gripper's are.
_WORDS = ("crank", "muscle", "implicit", "elliptic", "ball joint", "ellipsoids")
_SLOW = [one for one in _SCENES if any(word in one for word in _WORDS)]


@pytest.mark.filterwarnings("ignore::mjxgrad.scene.SceneWarning")
@pytest.mark.parametrize(
    "kind", [pytest.param(one, marks=pytest.mark.slow) if one in _SLOW else one for one in _SCENES]
)
def test_motion_and_derivatives_are_those_of_c_mujoco(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(robots, "_PHASES", (33,))  # the gripper's derivatives scatter, of any number of starts
    file = tmp_path / "scene.xml"
    file.write_text(_SCENES[kind])
    assert robots.failures("c_double", robots.measured_one("c_double", str(file))) == []
    # Which edges of the cylinder touch changes from step to step: its derivatives scatter, which is said.
    told = robots.measured_one("slope_single", str(file))["steps"]
    assert told == "right" or ("cylinder" in kind and told in ("consistent", "flagged"))


def test_the_slope_of_rk4_knows_that_each_of_its_stages_may_touch(monkeypatch):
    """A ball that lands: seeing the first stage alone the mean is off by several times the slope, now by a tenth."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option integrator="RK4"/><worldbody>{_FLOOR}<body pos="0 0 .141"><joint type="slide" axis="0 0 1"/>
        <geom size=".1"/></body></worldbody></mujoco>"""
    )
    monkeypatch.setattr(robots, "_PHASES", (33, 129))
    found = robots.many_steps(model, mg.load_scene(model))
    assert found["error"] < 0.25 * found["slope"]


def test_a_wrong_derivative_and_a_process_that_ends_are_failures():
    right: dict = {"A": 0.0, "B": 0.0, "motion": 0.0, "flagged": False, "warned": False}
    assert robots.failures("c_double", right) == []
    assert robots.failures("c_double", right | {"B": 2e-4}) == ["B is off by 0.0002"]
    assert robots.failures("mjx_single", right | {"motion": 0.01}) == ["motion is off by 0.01 without a warning"]
    assert robots.failures("mjx_single", right | {"A": np.nan}) == ["A is off by nan"]
    assert robots.failures("mjx_single", right | {"flagged": True}) == ["the step diverges"]
    (found,) = (one for _, one in robots.measured("load", ["missing.xml"], 60.0))
    assert found["nv"] == 0


def test_differences_of_rk4_are_those_that_mujoco_takes_of_euler():
    """A pendulum of small steps: both integrators are its flow to first order in the step, 1e-4."""
    found = []
    for integrator in ("RK4", "Euler"):
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="1e-4" integrator="{integrator}"/><worldbody><body><joint axis="0 1 0"/>'
            '<geom size=".1" pos=".3 0 0"/></body></worldbody></mujoco>'
        )
        found.append(robots.by_differences(model, robots.start_of(model))[1])
    np.testing.assert_allclose(*found, atol=1e-6)
