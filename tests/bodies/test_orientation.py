"""Chains of hinges and slides, against C MuJoCo."""

import jax
import mujoco
import numpy as np

from mjxgrad._mjx import mjx
from mjxgrad.bodies import kinematics
from tests.bodies.test_kinematics import PLACED, PLACES, ROUNDING

# Two chains about skew axes; slides before, between and after hinges, two hinges on a body, opposite axes, rotations of bodies
# that keep the axis and, at the tip, one that does not; bodies without joints on the world and on a chain.
CHAINS = """
<mujoco>
  <worldbody>
    <body pos="1 0 0" quat=".3 .2 -.5 .1"><geom size=".1"/></body>
    <body pos=".1 -.2 .3" quat=".9 .1 -.3 .2">
      <joint type="slide" axis="1 .5 0" pos=".1 0 .2" ref=".1"/>
      <joint axis="0 1 0" pos=".05 .1 -.1" ref=".3"/>
      <joint type="slide" axis="0 .3 1"/>
      <joint axis="0 -1 0" pos="-.1 0 .2"/>
      <geom type="box" size=".1 .2 .05" pos=".05 .03 .02" euler="10 20 30"/>
      <site pos=".1 .1 0" euler="30 0 10"/>
      <body pos=".3 0 .1" euler="0 40 0">
        <body pos="0 .2 0" euler="0 0 180">
          <joint axis="0 1 0" pos="0 0 -.1"/>
          <geom type="capsule" size=".03 .1" euler="20 30 10"/>
        </body>
        <body pos=".1 0 0" euler="20 30 40"><geom size=".1"/></body>
      </body>
    </body>
    <body pos="0 0 2">
      <joint axis="1 2 2" pos="0 .1 0"/>
      <geom type="capsule" size=".05 .2" euler="30 0 0"/>
      <body pos=".2 .1 0"><joint axis="1 2 2"/><geom size=".1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def test_poses_after_several_turns_are_those_of_c_mujoco():
    model = mujoco.MjModel.from_xml_string(CHAINS)
    reference = mujoco.MjData(model)
    reference.qpos[:] = 3 * np.random.default_rng(0).normal(size=model.nq)
    placed = jax.jit(kinematics.kinematics)(mjx.put_model(model), mjx.put_data(model, reference))
    mujoco.mj_kinematics(model, reference)
    for name in PLACES + PLACED:
        expected = np.asarray(getattr(reference, name)).reshape(getattr(placed, name).shape)
        np.testing.assert_allclose(getattr(placed, name), expected, rtol=0, atol=ROUNDING, err_msg=name)
