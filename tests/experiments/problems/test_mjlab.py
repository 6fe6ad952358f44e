"""mjlab's robots and their tasks; the robots are downloaded."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjxgrad as mg
from experiments.problems import mjlab
from experiments.problems.humanoid import pushed_humanoid
from experiments.problems.quadruped import go1_joystick
from experiments.problems.tracking import CLIPS, references, tracking

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tracker():
    return tracking()


def test_who_is_on_the_reference_earns_everything(tracker):
    """Weights add to 1, so that a mean is a share; half a radian off at each joint earns less than a half."""
    for clip, time in [(0, 49), (1, 12), (2, 99), (3, 30)]:
        then = (time + 1) % tracker.angles.shape[1]
        place = jnp.concatenate([jnp.zeros(2), tracker.heights[clip, then][None], jnp.array([1.0, 0, 0, 0])])
        state = mg.initial_state(
            tracker.scene,
            jnp.concatenate([place, tracker.angles[clip, then]]),
            jnp.concatenate([jnp.zeros(6), tracker.speeds[clip, then]]),
        )
        memory = {"clip": jnp.array(clip), "time": jnp.array(time), "action": jnp.zeros(29)}
        earned = lambda one, memory=memory: sum(tracker.rewards(one, jnp.zeros(29), one, memory).values())  # noqa: E731
        assert_allclose(earned(state), 1.0, rtol=1e-5)
        assert earned(dataclasses.replace(state, qpos=state.qpos.at[7:].add(0.5))) < 0.65


def test_references_are_within_reach_and_on_the_floor(tracker):
    """Joints stay in their ranges and can be commanded, clips begin at rest, and a foot touches the floor all the while."""
    model = mjlab.g1()
    angles, speeds, heights = references(model)
    assert angles.shape == (len(CLIPS), 100, 29)
    low, high = model.jnt_range[1:].T
    assert (angles > low).all()
    assert (angles < high).all()
    assert_allclose(angles[:, 0], np.broadcast_to(model.key_qpos[0, 7:], angles[:, 0].shape), atol=1e-12)
    # Seconds of an action from central differences; the sums of a period's speeds are zero.
    assert_allclose(speeds.sum(axis=1), 0, atol=1e-9)
    assert (np.abs(angles - model.key_qpos[0, 7:]).max(axis=(0, 1)) < np.asarray(tracker.reach)).all()
    data = mujoco.MjData(model)
    for clip, time in [(0, 50), (1, 12), (1, 37), (3, 20)]:
        data.qpos[:] = [0, 0, heights[clip, time] - 1e-4, 1, 0, 0, 0, *angles[clip, time]]
        mujoco.mj_forward(model, data)
        touched = [c for c in data.contact if 0 in model.geom_bodyid[[c.geom1, c.geom2]]]
        assert touched
        assert min(c.dist for c in touched) > -2e-3


def test_go1_stands_on_its_servos_and_touches_the_floor_alone():
    """For 2 s of C MuJoCo, held by its servos in its key frame."""
    robot = go1_joystick()
    model = robot.scene.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(500):
        mujoco.mj_step(model, data)
        assert all(0 in model.geom_bodyid[[c.geom1, c.geom2]] for c in data.contact)
    assert not robot.is_over(mg.initial_state(robot.scene, jnp.array(data.qpos), jnp.array(data.qvel)))
    assert np.abs(data.qvel).max() < 0.1


def test_pushes_come_every_two_seconds():
    """Of 0.2 to 0.7 m/s, into any direction, once."""
    task = pushed_humanoid()
    rest = mg.initial_state(task.scene)
    memory = jax.vmap(task.first_memory)(jax.random.split(jax.random.key(0), 64))
    step = jax.jit(jax.vmap(lambda one, key: task.next_memory(one, jnp.zeros(29), rest, key)))
    pushed = []
    for k in range(200):
        memory = step(memory, jax.random.split(jax.random.key(k), 64))
        pushed.append(np.asarray(jnp.linalg.norm(memory["push"], axis=1)))
    sizes = np.stack(pushed)
    assert 1 <= (sizes > 0).sum(axis=0).min() <= (sizes > 0).sum(axis=0).max() <= 2
    assert 0.2 <= sizes[sizes > 0].min() < sizes.max() <= 0.7
    one = jax.tree.map(lambda x: x[0], memory) | {"push": jnp.array([0.3, -0.4])}
    assert_allclose(task.disturbed(rest, one).qvel[:3] - rest.qvel[:3], [0.3, -0.4, 0], atol=1e-7)
