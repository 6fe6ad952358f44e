"""What MJX refuses or does otherwise than C MuJoCo, and is mended."""

import jax
import mujoco
import numpy as np

import mjxgrad as mg


def test_a_rangefinder_sees_a_scene_without_materials():
    scene = mg.load_scene("""<mujoco><worldbody><geom type="plane" size="9 9 1"/><body pos="0 0 .5">
      <freejoint/><geom size=".1"/><site name="down" pos="0 0 -.1" zaxis="0 .1 -1"/></body></worldbody>
      <sensor><rangefinder name="height" site="down"/></sensor></mujoco>""")
    data = mujoco.MjData(scene.mj_model)
    mujoco.mj_forward(scene.mj_model, data)
    found = jax.jit(mg.forward)(scene.model, scene.data).sensordata
    np.testing.assert_allclose(found, data.sensordata, rtol=1e-12)
    assert found[0] > 0.4
