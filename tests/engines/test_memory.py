"""What C MuJoCo cannot do for want of memory is a warning, and no number."""

import gc
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import mjxgrad as mg

TASKS = Path("/proc/self/task")
BOXES = "".join(
    f'<body pos="0 0 {0.1 + 0.19 * i}"><freejoint/><geom type="box" size=".1 .1 .1"/></body>' for i in range(6)
)
XML = f'<mujoco><size memory="40K"/><worldbody><geom type="plane" size="1 1 1"/>{BOXES}</worldbody></mujoco>'


def test_a_derivative_for_which_the_file_leaves_no_memory_is_no_number_and_said_in_a_sentence():
    """Steps of this pile fit into 40 kB; the constraints that its derivatives compare do not."""
    scene = mg.load_scene(XML, engine="mujoco")

    def height(speed):
        start = mg.initial_state(scene, qvel=speed)
        return mg.rollout(scene, start, horizon=3, contact=mg.Slope()).qpos[-1, 2]

    with pytest.warns(mg.scene.SceneWarning, match=r"C MuJoCo gave up, and its numbers are NaN: mj_stackAlloc"):
        slopes = jax.vmap(jax.grad(height))(jnp.zeros((2, scene.model.nv)))
    assert slopes.shape == (2, scene.model.nv)
    assert jnp.isnan(slopes).all()


@pytest.mark.skipif(not TASKS.is_dir(), reason="threads of C++ are counted by Linux")
def test_threads_of_scenes_that_are_no_longer_used_end():
    """Programs are kept, but pools of threads only for the last few scenes: eighteen have as many threads as nine."""
    counts = []
    for number in range(18):
        scene = mg.load_scene(XML.replace("<body pos", f'<site pos="0 0 {number}"/><body pos', 1), engine="mujoco")
        mg.rollout(scene, mg.initial_state(scene), horizon=1)
        counts.append(len(list(TASKS.iterdir())))
    gc.collect()
    assert len(list(TASKS.iterdir())) <= counts[9] + 2
