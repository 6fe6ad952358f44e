"""Chains that turn about one axis each: which they are, and that angles give what products of turns give."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjxgrad._mjx import mjx
from mjxgrad.bodies import kinematics, orientation, tree
from tests.bodies.test_kinematics import PLACED, PLACES, ROUNDING

# Two chains about skew axes; slides before, between and after hinges, two hinges on a body, opposite axes, rotations of bodies
# that keep the axis and, at the tip, one that does not; bodies without joints on the world and on a chain.
PLANAR = """
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
      <joint axis="{axis}" pos="0 .1 0"/>
      <geom type="capsule" size=".05 .2" euler="30 0 0"/>
      <body pos=".2 .1 0"><joint axis="1 2 2"/><geom size=".1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
FIELDS = PLACES + PLACED
# Under jax.jit numbers of an argument are not known, and turns are multiplied.
by_products = jax.jit(kinematics.kinematics)


def load(axis="1 2 2"):
    model = mujoco.MjModel.from_xml_string(PLANAR.format(axis=axis))
    reference = mujoco.MjData(model)
    # Angles of several turns.
    reference.qpos[:] = 3 * np.random.default_rng(0).normal(size=model.nq)
    return model, reference


def is_planar(model):
    return orientation.chains(model, tree.frames(model)) is not None


def test_angles_give_the_poses_of_c_mujoco():
    model, reference = load()
    device, data = mjx.put_model(model), mjx.put_data(model, reference)
    assert is_planar(device)
    placed = jax.jit(lambda data: kinematics.kinematics(device, data))(data)
    mujoco.mj_kinematics(model, reference)
    for name in FIELDS:
        expected = np.asarray(getattr(reference, name)).reshape(getattr(placed, name).shape)
        np.testing.assert_allclose(getattr(placed, name), expected, rtol=0, atol=ROUNDING, err_msg=name)


def test_derivatives_of_angles_are_those_of_products():
    model, reference = load()
    device, data = mjx.put_model(model), mjx.put_data(model, reference)
    random = np.random.default_rng(1)
    weights = {name: random.normal(size=getattr(data, name).shape) for name in FIELDS}
    lengths = {name: getattr(device, name) for name in ("body_pos", "jnt_pos", "geom_pos", "geom_quat", "body_ipos")}

    def value(kinematics, qpos, lengths):
        placed = kinematics(device.replace(**lengths), data.replace(qpos=qpos))
        return sum(jnp.sum(w * getattr(placed, name)) for name, w in weights.items())

    ours, theirs = (
        jax.jit(jax.grad(lambda *x, k=k: value(k, *x), argnums=(0, 1)))(data.qpos, lengths)
        for k in (kinematics.kinematics, by_products)
    )
    for found, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING * max(1, np.abs(expected).max()))


@pytest.mark.parametrize("axis", ["1 2 2.000001", "0 1 0"])
def test_axes_that_are_not_parallel_are_multiplied(axis):
    """Not even those that nearly are; single precision, which could not tell, would have its own tolerance."""
    assert not is_planar(mjx.put_model(load(axis)[0]))


def test_what_is_differentiated_by_is_not_known():
    """The derivative by an axis leaves the plane: that of the pose, which angles do not have, must be there."""
    model, reference = load()
    device, data = mjx.put_model(model), mjx.put_data(model, reference)

    def height(axis, kinematics):
        return kinematics(device.replace(jnt_axis=axis), data).geom_xpos[:, 2].sum()

    slope = jax.jit(jax.grad(height), static_argnums=1)
    found = slope(device.jnt_axis, kinematics.kinematics)
    assert np.abs(found).max() > 0.1
    np.testing.assert_allclose(found, slope(device.jnt_axis, by_products), rtol=0, atol=ROUNDING)
