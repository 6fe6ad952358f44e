"""Derivatives of a step from its solution, against whole steps of C MuJoCo from a fresh MjData.

`mjd_transitionFD` is no truth here: it keeps the integrator's factorisation, and is off by up to a quarter in some of these.
"""

import mujoco
import numpy as np
import pytest

from mjxgrad.engines import inverse, jacobians
from mjxgrad.engines.pool import Pool
from tests.engines.whole_steps import by_whole_steps

ARM = """<body pos="0 0 1"><joint name="a" axis="0 1 0" {joint}/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1"/>
  <site name="s0" pos=".2 0 .05"/><body pos=".4 0 0"><joint name="b" axis="0 1 0" {joint}/>
  <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass=".5"/><site name="s1" pos=".2 0 .05"/></body></body>"""
TENDON = '<tendon><spatial name="t" {tendon}><site site="s0"/><site site="s1"/></spatial></tendon>'
# Of joints, tendons, actuators and options.
PARTS = {
    "polynomial damping": ('damping=".1 .3 .3"', "", "", ""),
    "damper": ("", "", '<damper joint="a" kv="10" ctrlrange="0 1"/><motor joint="b"/>', ""),
    "muscle": ("", " ", '<muscle tendon="t" lengthrange=".1 .6"/>', ""),
    "gain affine in velocity": ("", "", '<general joint="a" gaintype="affine" gainprm="1 0 -3" biastype="none"/>', ""),
    "motor with resistance": ("", "", '<dcmotor joint="a" motorconst="1 1" resistance="1"/>', ""),
    "servo near its limit": ("", "", '<position joint="a" kp="50" kv="5" forcerange="-60 60"/>', ""),
    "tendon's polynomial damping": ("", 'damping="1 20 20"', "", ""),
    "actuator's polynomial damping": ("", "", '<motor joint="a" damping=".1 .5 .5"/>', ""),
    "drag": ("", "", "", 'density="1000" viscosity=".1"'),
}
INTEGRATORS = ("Euler", "implicitfast", "implicit", "discrete")


def _model(integrator, joint, tendon, actuators, options):
    arm = ARM.format(joint=joint)
    arm = arm.replace('mass="1"', 'mass="1" fluidshape="ellipsoid"') if options else arm
    strings = TENDON.format(tendon=tendon.strip()) if tendon else ""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep=".005" integrator="{integrator}" {options}/><worldbody>{arm}</worldbody>{strings}'
        f"<actuator>{actuators}</actuator></mujoco>"
    )
    model.opt.tolerance = 1e-14
    return model


def assert_is_of_whole_steps(model, qpos, qvel, act, ctrl, **inputs):
    """A and B are differences of whole steps to 1e-6 of the largest entry, which is what these leave."""
    engine = Pool(model)
    before = {"time": [[0.0]], "qpos": [qpos], "qvel": [qvel], "act": [act]}
    before = {name: np.array([value], float) for name, value in before.items()}
    given = {name: np.array([[value]], float) for name, value in {"ctrl": ctrl, **inputs}.items()}
    found = engine.maps({}, before, given, engine.no_flight((1,)), gradient="discrete", wanted=("ctrl",))
    ours = np.concatenate([found["state"][0, 0], found["ctrl"][0, 0]], axis=1)
    expected = np.concatenate(by_whole_steps(model, qpos, qvel, act, ctrl, **inputs), axis=1)
    np.testing.assert_allclose(ours, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("part", PARTS)
def test_a_step_has_the_derivative_of_whole_steps(part, integrator):
    try:
        model = _model(integrator, *PARTS[part])
    except ValueError:
        pytest.skip("this MuJoCo has no such integrator")
    rng = np.random.default_rng(0)
    qpos, qvel = 0.3 * rng.normal(size=model.nq), 3 * rng.normal(size=model.nv)
    assert_is_of_whole_steps(model, qpos, qvel, 0.5 * np.ones(model.na), 0.5 * np.ones(model.nu))


BOX = """<mujoco><option cone="{cone}" integrator="{integrator}" tolerance="1e-14" iterations="200"/><worldbody>
  <geom type="plane" size="2 2 .1"/><body pos="0 0 .098" euler="1 2 3"><freejoint/><geom type="box" size=".1 .15 .1" mass="1"/>
  <body pos="0 0 .1"><joint name="j" type="ball" range="0 20" limited="true" damping=".1" frictionloss=".02"/>
  <geom type="capsule" fromto="0 0 0 .1 0 .2" size=".02"/></body></body></worldbody>
  <actuator><motor joint="j" gear="1 2 3"/><general joint="j" gear="0 1 0" dyntype="filter" dynprm=".05" gainprm="3"/></actuator>
  </mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_a_pulled_body_in_contact_beyond_its_limit_has_it_too(cone, integrator):
    """A turned box on the floor, with an arm beyond a ball joint's limit, under forces that turn with its bodies."""
    model = mujoco.MjModel.from_xml_string(BOX.format(cone=cone, integrator=integrator))
    rng, qpos = np.random.default_rng(1), model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, np.concatenate([0.01 * rng.normal(size=6), [0.5, 0.1, 0.2]]), 1.0)
    pull = rng.normal(size=(model.nbody, 6))
    assert_is_of_whole_steps(model, qpos, rng.normal(size=9), np.array([0.3]), np.array([0.2, -0.1]), xfrc_applied=pull)


def test_a_control_at_its_limit_has_the_derivative_of_its_inside():
    """`mjd_transitionFD` has the same rule; a control beyond the limit does nothing."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j"/><geom size=".1" pos=".1 0 0"/></body></worldbody><actuator>
        <motor joint="j" ctrlrange="-1 1"/><motor joint="j" ctrlrange="-1 1"/><motor joint="j" ctrlrange="-1 1"/></actuator>
        </mujoco>"""
    )
    engine, before = Pool(model), {name: np.zeros((1, 1, 1)) for name in ("time", "qpos", "qvel")}
    found = engine.maps(
        {},
        before,
        {"ctrl": np.array([[[1.0, 0.0, 1.1]]])},
        engine.no_flight((1,)),
        gradient="discrete",
        wanted=("ctrl",),
    )
    at_limit, inside, beyond = found["ctrl"][0, 0, 1]
    np.testing.assert_allclose(at_limit, inside, rtol=1e-6)
    assert inside > 0
    assert beyond == 0.0


WALKER = """<mujoco><option timestep=".005" integrator="implicitfast"/><worldbody><geom type="plane" size="5 5 .1"/>
  <body name="trunk" pos="0 0 .298"><freejoint/><geom type="box" size=".1 .1 .05" mass="1"/><site name="imu" pos=".05 0 .03"/>
    <body pos="0 0 -.05"><joint name="hip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".05" mass=".2"/>
      <site name="sole" pos="0 0 -.2" size=".06"/></body></body></worldbody>
  <actuator><motor name="m" joint="hip" ctrlrange="-1 1" gear="3"/><general joint="hip" dyntype="filter" dynprm=".1" gainprm="2"/>
  </actuator>
  <sensor>{}</sensor></mujoco>"""
OF_PLACES = """<framepos objtype="site" objname="sole"/><jointpos joint="hip"/><subtreecom body="trunk"/><rangefinder site="imu"/>
  <actuatorpos actuator="m"/>"""
OF_SPEEDS = (
    OF_PLACES
    + """<gyro site="imu"/><velocimeter site="imu"/><subtreelinvel body="trunk"/><actuatorvel actuator="m"/>"""
)
OF_FORCES = (
    OF_SPEEDS + """<accelerometer site="imu"/><touch site="sole"/><force site="sole"/><actuatorfrc actuator="m"/>"""
)


@pytest.mark.parametrize("sensors", [OF_PLACES, OF_SPEEDS, OF_FORCES], ids=["places", "speeds", "forces"])
@pytest.mark.parametrize("control", [0.3, 1.0], ids=["within its range", "at its end, where it moves inwards"])
def test_sensors_have_the_derivative_of_whole_readings(control, sensors):
    """In contact; `mjd_transitionFD` of MuJoCo 3.17, centred, has the wrong sign by controls."""
    model, size, width = mujoco.MjModel.from_xml_string(WALKER.format(sensors)), 17, 1e-6
    model.opt.tolerance = 1e-14
    random = np.random.default_rng(0)
    qvel, act, ctrl = 0.1 * random.normal(size=7), np.array([0.2]), np.array([control, 0.5])

    def read(change):
        data = mujoco.MjData(model)
        data.qvel, data.act, data.ctrl = qvel + change[7:14], act + change[14], ctrl + change[15:]
        mujoco.mj_integratePos(model, data.qpos, change[:7], 1.0)
        mujoco.mj_forward(model, data)
        return data.sensordata.copy()

    expected = np.empty((model.nsensordata, size))
    for column, change in enumerate(width * np.eye(size)):
        above = 0.0 * change if column == 15 and control == 1.0 else change
        expected[:, column] = (read(above) - read(-change)) / (width + above.max())
    states = {"time": [[0.0]], "qpos": [model.qpos0], "qvel": [qvel], "act": [act]}
    states = {name: np.array(value, float) for name, value in states.items()}
    found = Pool(model).sense({}, states, {"ctrl": ctrl[None]}, wanted=("state", "ctrl"))
    found = np.concatenate([found["state"][0], found["ctrl"][0]], axis=1)
    assert np.abs(expected[:, 15]).max() > 1 or sensors != OF_FORCES
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_a_step_whose_solver_finds_no_end_takes_no_whole_steps(monkeypatch):
    """A motion that explodes took a second for each of its steps: hundreds of whole ones, each of 200 iterations."""
    model = mujoco.MjModel.from_xml_string(BOX.format(cone="elliptic", integrator="Euler").replace('"200"', '"1"'))
    monkeypatch.setattr(jacobians, "_ITERATIONS", 1)
    monkeypatch.setattr(jacobians.Worker, "_by_steps", lambda *_: pytest.fail("whole steps were taken"))
    engine, data = Pool(model), mujoco.MjData(model)
    before = {"time": np.zeros((1, 1, 1)), "act": np.zeros((1, 1, model.na))}
    before |= {"qpos": data.qpos[None, None].copy(), "qvel": np.linspace(1, -2, model.nv)[None, None]}
    found = engine.maps(
        {}, before, {"ctrl": np.zeros((1, 1, model.nu))}, engine.no_flight((1,)), gradient="discrete", wanted=()
    )
    assert np.isfinite(found["state"]).all()
    assert np.abs(found["state"]).max() > 0


def test_a_motion_that_diverges_ends_in_no_error():
    """Of accelerations of 1e12 rad/s² those that a difference adds are lost, so that a row of its derivative is zero."""
    model = _model("Euler", "", "", "", "")
    engine = Pool(model)
    by, row = inverse.Inverse(model, engine.layout), np.zeros(engine.layout.size)
    found = by.solutions(row, np.zeros(2), np.diag([1.0, 0.0]), np.zeros((1, 2)))
    assert np.isfinite(found).all()
