"""The smooth stages against C MuJoCo, and their derivatives against each other."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjxgrad._mjx import mjx
from mjxgrad.bodies import forces, kinematics
from tests.scenes import ASSETS

# Sums of some tens of products of numbers of order one, in another order than the reference takes them.
ROUNDING = 1e3 * np.finfo(float).eps
# Every joint type, several joints on a body, fixed and offset bodies, two trees, a mocap body with a body fixed to it.
ZOO = """
<mujoco>
  <option><flag contact="disable" constraint="disable"/></option>
  <worldbody>
    <site pos=".1 .2 .3"/>
    <body pos=".1 -.2 .3" quat=".9 .1 -.3 .2">
      <joint type="slide" axis="1 .5 0" pos=".1 0 .2" damping=".3" stiffness="2" ref=".1"/>
      <joint axis="0 1 .5" pos=".05 .1 -.1" armature=".2" springref=".2" stiffness="3" ref=".3"/>
      <joint name="slide" type="slide" axis="0 0 1" armature=".1"/>
      <joint name="hinge" axis="1 0 1" pos="-.1 0 .2" damping=".2"/>
      <geom type="box" size=".1 .2 .05" pos=".05 .03 .02" euler="10 20 30" mass=".8"/>
      <site pos=".1 .1 0" euler="30 0 10"/>
      <body pos=".3 0 .1" euler="20 0 40">
        <geom size=".05" pos="0 .1 0" mass=".2"/>
        <body pos="0 .2 0" euler="0 30 0">
          <joint type="ball" pos=".02 .03 -.04" stiffness="1.5" damping=".1" armature=".02"/>
          <inertial pos=".05 .02 -.03" mass=".7" fullinertia=".02 .03 .025 .002 -.001 .003"/>
          <body pos="0 0 .3">
            <joint axis="0 1 0" pos="0 0 -.1"/>
            <geom type="capsule" size=".03 .1" mass=".3"/>
          </body>
        </body>
        <body pos=".2 0 0">
          <joint axis="0 0 1"/>
          <joint type="ball" pos="0 .1 0"/>
          <geom type="capsule" size=".03 .1" pos=".1 0 0" mass=".3"/>
        </body>
      </body>
    </body>
    <body mocap="true" pos="1 0 1" quat=".5 .5 .1 0">
      <geom type="box" size=".1 .1 .1"/>
      <body pos="0 .2 0"><geom size=".1" pos=".1 0 0"/></body>
    </body>
    <body pos="0 0 2">
      <joint type="free" damping=".1" stiffness=".7" armature=".05"/>
      <inertial pos=".1 -.05 .03" quat=".8 .2 .1 -.3" mass="1.3" diaginertia=".1 .2 .15"/>
      <geom type="box" size=".1 .1 .1"/>
      <body pos=".2 .1 0" euler="0 0 20">
        <joint name="arm" axis="0 1 1" pos=".03 0 0" armature=".1" actuatorfrcrange="-1 1"/>
        <geom type="capsule" size=".05 .2" euler="30 0 0" pos="0 .1 .1" mass=".4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="arm" gear="5" ctrlrange="-.3 .3" ctrllimited="true"/>
    <position joint="hinge" kp="3" kv=".2" forcerange="-.2 .2" forcelimited="true"/>
    <motor joint="slide" gear="-2"/>
  </actuator>
</mujoco>
"""
PLACES = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis")
PLACED = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat")
MOTIONS = ("subtree_com", "cinert", "crb", "cdof", "cvel", "cdof_dot")
FORCES = (
    "qfrc_bias", "qfrc_passive", "qfrc_gravcomp", "actuator_length", "actuator_velocity", "actuator_force", "qfrc_actuator",
    "qfrc_smooth", "qacc_smooth",
)  # fmt: skip
LEAVES = (
    "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "geom_pos", "jnt_pos", "jnt_axis",
    "jnt_stiffness", "dof_armature", "dof_damping", "qpos_spring", "actuator_gear", "actuator_gainprm",
)  # fmt: skip


def load(name):
    if name == "zoo":
        return mujoco.MjModel.from_xml_string(ZOO)
    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return model


def random_state(model):
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    for name in ("qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat"):
        getattr(data, name)[:] = rng.normal(size=getattr(data, name).shape)
    data.xfrc_applied[0] = 0
    return data


def run(model, data):
    """All stages, in the order of a step."""
    data = kinematics.com_pos(model, kinematics.kinematics(model, data))
    data = forces.transmission(model, kinematics.crb(model, data))
    data = forces.fwd_actuation(model, forces.fwd_velocity(model, data))
    return forces.fwd_acceleration(model, data)


def field(data, name):
    owner = data._impl if name in type(data._impl).__dataclass_fields__ else data
    return np.asarray(getattr(owner, name))


def assert_close(value, expected, name):
    assert value.size == expected.size, name
    expected = expected.reshape(value.shape)
    scale = max(1.0, np.abs(expected).max(initial=0.0))
    np.testing.assert_allclose(value, expected, rtol=0, atol=ROUNDING * scale, err_msg=name)


@pytest.mark.parametrize("name", ["zoo", "hopper", "ant"])
def test_every_field_is_that_of_c_mujoco(name):
    """Quaternions of any norm are normalised alike."""
    model = load(name)
    reference = random_state(model)
    data = jax.jit(run)(mjx.put_model(model), mjx.put_data(model, reference))
    mujoco.mj_forward(model, reference)
    for each in PLACES + PLACED + MOTIONS + FORCES:
        value, expected = field(data, each), np.asarray(getattr(reference, each))
        if each in ("cinert", "crb"):  # MuJoCo leaves the world's unset.
            value, expected = value[1:], expected[1:]
        assert_close(value, expected, each)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, reference, mass)
    assert_close(field(data, "M"), mass, "M")


@pytest.fixture(scope="module")
def zoo():
    """A number that depends on every output, of the model's leaves and the state; and where to take it."""
    model = load("zoo")
    device, state = mjx.put_model(model), mjx.put_data(model, random_state(model))
    leaves = {name: getattr(device, name) for name in LEAVES} | {"gravity": device.opt.gravity}
    names = ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat", "xfrc_applied")
    point = leaves | {name: getattr(state, name) for name in names}
    outputs = ("xpos", "geom_xmat", "site_xpos", "subtree_com", "cdof_dot", "qfrc_smooth", "qacc_smooth")
    rng = np.random.default_rng(1)
    weights = {name: rng.normal(size=getattr(state, name).shape) for name in outputs}

    def value(point):
        point = dict(point)
        changed = device.tree_replace({"opt.gravity": point.pop("gravity")})
        changed = changed.replace(**{name: point.pop(name) for name in LEAVES})
        data = run(changed, state.replace(**point))
        return sum(jnp.sum(w * getattr(data, name)) for name, w in weights.items())

    direction = {name: jnp.asarray(rng.normal(size=x.shape)) for name, x in point.items()}
    return value, jax.jit(jax.grad(value)), point, direction


def test_both_modes_agree_with_central_differences(zoo):
    function, gradient, point, direction = zoo
    reverse = sum(np.sum(g * direction[name]) for name, g in gradient(point).items())

    def value(step):
        return function(jax.tree.map(lambda x, v: x + step * v, point, direction))

    h, both = 1e-5, jax.jit(lambda step: jax.jvp(value, (step,), (1.0,)))
    far, near = ([both(sign * step)[0] for sign in (1, -1)] for step in (2 * h, h))
    differences = (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * h)
    np.testing.assert_allclose(both(0.0)[1], reverse, rtol=ROUNDING)
    # Rounding of the values, of which some terms are a hundred times their sum, over the step.
    np.testing.assert_allclose(differences, reverse, rtol=1e-8)


def test_the_derivative_is_finite_at_rest(zoo):
    """At the reference pose, where springs have no stretch, with a world that has no mass."""
    _, gradient, point, _ = zoo
    rest = point | {"qpos": point["qpos_spring"], "qvel": jnp.zeros_like(point["qvel"])}
    for name, leaf in gradient(rest).items():
        assert np.isfinite(leaf).all(), name
