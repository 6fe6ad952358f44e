"""Forces between geoms by name, against C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg

_SCENE = """
<mujoco>
  <option cone="{cone}" tolerance="1e-14" iterations="100"/>
  <custom>{custom}</custom>
  <default><geom condim="{condim}"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body pos="0 0 .0499"><freejoint/><geom name="box" type="box" size=".1 .1 .05" mass="1"/></body>
    <body pos="0 .3 .0499"><freejoint/><geom name="ball" size=".05" mass=".5"/></body>
    <body pos="0 .3 .15"><geom name="lamp" size=".02" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>
"""
_SLIDING = np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.4, 0.2, -0.1, -0.01, 3.0, 0.0, 5.0])


@pytest.mark.parametrize(
    ("cone", "condim", "custom"),
    [
        ("pyramidal", 1, ""),
        ("pyramidal", 3, ""),
        ("elliptic", 6, ""),
        ("pyramidal", 6, '<numeric name="max_contact_points" data="5"/>'),  # whose slots are given out at run time
    ],
)
def test_the_force_between_two_geoms_is_cs(cone, condim, custom):
    scene = mg.load_scene(_SCENE.format(cone=cone, condim=condim, custom=custom))

    def look(model, data):
        return jnp.stack([mg.contact_force(model, data, *names) for names in (("floor", "box"), ("ball", "floor"))])

    start = mg.initial_state(scene, qvel=_SLIDING)
    found = jax.jit(lambda: mg.rollout(scene, start, horizon=1, observe=look).observations[0])()
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    data.qvel[:] = _SLIDING
    mujoco.mj_forward(model, data)
    on_body = {"box": np.zeros(3), "ball": np.zeros(3)}
    for number in range(data.ncon):
        force, contact = np.zeros(6), data.contact[number]
        mujoco.mj_contactForce(model, data, number, force)
        on_body[model.geom(contact.geom2).name] += contact.frame.reshape(3, 3).T @ force[:3]
    np.testing.assert_allclose(found, [on_body["box"], -on_body["ball"]], rtol=1e-5, atol=1e-5)
    assert np.abs(on_body["box"]).max() > 1
