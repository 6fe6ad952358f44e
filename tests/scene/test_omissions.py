"""What is left out is not missed."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.scene import load_scene

# A ball rolls on a floor beside a pendulum.
FURNISHED = """
<mujoco>
  <option timestep="0.005" tolerance="1e-12" jacobian="sparse"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="ball" pos="0 0 0.095"><freejoint/><geom size="0.1"/></body>
    <body pos="2 0 1"><joint type="hinge" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body>
  </worldbody>
  {rest}
</mujoco>
"""
SCENE = FURNISHED.format(rest="")


@jax.jit
def _roll(model, data):
    def step(data, _):
        data = mg.step(model, data)
        return data, (data.qpos, data.qvel)

    data = data.replace(qvel=jnp.linspace(0.5, -0.7, model.nv))
    return jax.lax.scan(step, data, length=20)[1]


@pytest.mark.parametrize("softness", [None, mg.Softness(stiffness=400, damping_ratio=0.5)])
def test_with_everything_kept_the_trajectory_is_the_same_to_rounding(softness):
    lean = load_scene(SCENE, softness=softness)
    full = load_scene(SCENE, softness=softness, keep_everything=True)
    trajectories = (_roll(scene.model, scene.data) for scene in (lean, full))
    for ours, theirs in zip(*trajectories, strict=True):
        # Rounding of 1e-16 per operation, in 20 steps of a ball that slides.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_keeping_everything_keeps_the_flags_of_the_file():
    scene = load_scene(SCENE, keep_everything=True)
    given = mujoco.MjModel.from_xml_string(SCENE)
    assert scene.omissions == ()
    assert scene.conversions == ()
    assert int(scene.model.opt.disableflags) == given.opt.disableflags
    assert int(scene.model.opt.jacobian) == given.opt.jacobian
    assert float(scene.model.opt.tolerance) == given.opt.tolerance


def test_each_omission_gives_its_reason():
    reasons = {o.what: o.reason for o in load_scene(SCENE).omissions}
    assert all(reasons.values())
    assert set(reasons) == {
        "tendons", "equality constraints", "friction loss", "limits", "actuation", "gravity compensation",
        "fluid forces", "implicit damping",
    }  # fmt: skip


def test_what_the_scene_needs_is_not_left_out():
    rest = """<actuator><motor joint='h'/></actuator><equality><joint joint1='h'/></equality>
        <tendon><fixed><joint joint='h' coef='1'/></fixed></tendon>"""
    joint = "name='h' type='hinge' damping='1' frictionloss='1' limited='true' range='-9 9'"
    source = FURNISHED.replace('type="hinge"', joint).format(rest=rest)
    assert {o.what for o in load_scene(source).omissions} == {"gravity compensation", "fluid forces"}


def test_implicit_damping_is_left_out_only_where_nothing_is_damped():
    eulerdamp = mujoco.mjtDisableBit.mjDSBL_EULERDAMP.value
    assert int(load_scene(SCENE).model.opt.disableflags) & eulerdamp
    damped = SCENE.replace('type="hinge"', 'type="hinge" damping="1"')
    assert not int(load_scene(damped).model.opt.disableflags) & eulerdamp
    assert not load_scene(SCENE).mj_model.opt.disableflags & eulerdamp


def test_without_a_pair_that_can_touch_nothing_is_collided():
    scene = load_scene(SCENE.replace("<geom ", "<geom contype='0' conaffinity='0' "))
    assert "collision detection" in {o.what for o in scene.omissions}
    assert scene.data._impl.ncon == 0
