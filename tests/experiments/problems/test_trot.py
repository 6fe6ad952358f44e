"""The trot on ANYmal: the robot against published numbers and rest in C MuJoCo, the task against formulas in numpy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.problems.trot import trot
from mjxgrad import learning
from mjxgrad.rollouts import initial_state

LEGS = ("LF", "RF", "LH", "RH")
HIP, KNEE = np.pi / 6, np.pi / 4  # of the stance
STANCE = np.array([0, HIP, -KNEE, 0, HIP, -KNEE, 0, -HIP, KNEE, 0, -HIP, KNEE])


@pytest.fixture(scope="module")
def env():
    return trot()


@pytest.fixture(scope="module")
def model(env):
    return env.scene.to_mujoco()


def test_the_robot_weighs_what_is_published(model):
    """Kg: the base with all that is fixed to it, and per leg hip, thigh and shank with foot."""
    masses = {"base": 19.2035} | {
        f"{leg}_{part}": mass for leg in LEGS for part, mass in (("hip", 2.781), ("thigh", 3.071), ("shank", 0.58842))
    }
    for name, mass in masses.items():
        assert model.body(name).mass[0] == mass
    assert_allclose(model.body_mass.sum(), 19.2035 + 4 * (2.781 + 3.071 + 0.58842), rtol=1e-12)
    assert model.nv == 6 + 12
    assert model.nu == 12


def foot_height(hip, knee):
    """Height of a front foot's centre above the base and the hip's axis, in m; a positive angle moves the foot back."""
    return -0.285 * np.cos(hip) - 0.08795 * np.sin(hip + knee) - 0.31547 * np.cos(hip + knee)


def test_the_robot_stands_on_its_feet_by_its_servos(env, model):
    """In C MuJoCo: after 20 s at rest on four feet that carry its weight, 5 cm lower, since soft feet creep outward."""
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = env.stance, env.control(jnp.zeros(12))
    assert_allclose(data.qpos[2] + foot_height(HIP, -KNEE), 0.03, atol=1e-4)
    mujoco.mj_step(model, data, 10_000)
    assert np.abs(data.qvel).max() < 1e-3
    assert data.ncon == 4
    force = np.zeros(6)
    carried = 0.0
    for contact in range(4):
        mujoco.mj_contactForce(model, data, contact, force)
        carried += force[0]
    assert_allclose(carried, 9.81 * model.body_mass.sum(), rtol=1e-3)
    assert 0 < env.stance[2] - data.qpos[2] < 0.05
    assert_allclose(data.qpos[3:7], [1, 0, 0, 0], atol=0.02)


def reference(num_actions):
    """Angles and speeds of all joints and heights of the feet that the gait has after so many actions of 20 ms.

    Diagonal legs rise in turn for 0.26 s: RF and LH, then LF and RH. Hips turn by 0.15 (1 - cos(2 pi t / 0.26)) rad, knees
    by twice as much the other way, and on hind legs both turn the other way.
    """
    t = 0.02 * (num_actions % 26)
    rate = 2 * np.pi / 0.26
    angle, speed = 0.15 * (1 - np.cos(rate * t)), 0.15 * rate * np.sin(rate * t)
    is_lifted = np.array([False, True, True, False]) ^ (t >= 0.26 - 1e-9)
    leg = np.array([0, 1, -2])
    bent = np.array([1, 1, -1, -1])
    angles = STANCE + np.concatenate([is_lifted[k] * bent[k] * angle * leg for k in range(4)])
    speeds = np.concatenate([is_lifted[k] * bent[k] * speed * leg for k in range(4)])
    heights = 0.56 + np.array([foot_height(HIP + up * angle, -KNEE - 2 * up * angle) for up in is_lifted])
    return angles, speeds, heights


def state_of(env, seed):
    """A state in which all numbers differ."""
    rng = np.random.default_rng(seed)
    quaternion = np.array([1, 0.2, -0.1, 0.3]) + 0.1 * rng.standard_normal(4)
    place = np.array([0.1, -0.2, 0.5]) + 0.1 * rng.standard_normal(3)
    qpos = np.concatenate([place, quaternion / np.linalg.norm(quaternion), STANCE + 0.1 * rng.standard_normal(12)])
    return initial_state(env.scene, jnp.array(qpos), jnp.array(rng.standard_normal(18)))


@eqx.filter_jit
def _rewards(env, *given):
    return env.rewards(*given)


@pytest.mark.parametrize("num_actions", [0, 5, 13, 26 + 17])
def test_the_reward_is_the_distance_from_the_gait(env, model, num_actions):
    """Of joints and base before the action and of the feet after it, whose places are C MuJoCo's."""
    before, after = state_of(env, 1), state_of(env, 2)
    memory = {"num_actions": jnp.array(num_actions), "targets": jnp.zeros(12)}
    terms = _rewards(env, before, jnp.zeros(12), after, memory)
    angles, speeds, heights = reference(num_actions)
    place = np.concatenate([before.qpos[:3] - np.array([0, 0, 0.56]), before.qpos[7:] - angles])
    speed = before.qvel - np.concatenate([np.zeros(6), speeds])
    assert_allclose(terms["joints"], -0.0075 * (np.linalg.norm(place) + np.linalg.norm(speed)), rtol=1e-6)
    data = mujoco.MjData(model)
    data.qpos[:] = after.qpos
    mujoco.mj_kinematics(model, data)
    found = np.array([data.geom(f"{leg}_foot").xpos[2] for leg in LEGS])
    # The lengths of the legs are known to 1e-6 m.
    assert_allclose(terms["feet"], -np.abs(found - heights).sum(), atol=2e-5)
    assert set(terms) == {"joints", "feet"}


def test_the_policy_sees_turning_down_posture_targets_and_the_last_reference(env):
    """Of the reference of the action that led there; at the start, where none did, of the first."""
    state, targets = state_of(env, 3), np.linspace(-1, 1, 12)
    w, x, y, z = np.asarray(state.qpos[3:7])
    down = [-2 * (x * z - w * y), -2 * (y * z + w * x), -(1 - 2 * (x * x + y * y))]
    for num_actions, shown in ((0, 0), (1, 0), (9, 8), (26, 25), (27, 0)):
        seen = env.observe(state, {"num_actions": jnp.array(num_actions), "targets": jnp.array(targets)})
        expected = [[0.25 * state.qvel[5]], down, state.qpos[7:] - STANCE, targets, reference(shown)[0]]
        assert_allclose(seen, np.concatenate(expected), atol=1e-7)


@pytest.mark.parametrize(
    ("height", "tilt", "is_over"), [(0.26, 0.0, False), (0.24, 0.0, True), (0.5, 1.5, False), (0.5, 1.6, True)]
)
def test_it_is_over_below_25_cm_and_beyond_a_quarter_turn(env, height, tilt, is_over):
    qpos = env.stance.at[2].set(height).at[3:7].set(jnp.array([np.cos(tilt / 2), np.sin(tilt / 2), 0, 0]))
    assert bool(env.is_over(initial_state(env.scene, qpos))) == is_over


def test_whoever_stands_still_is_charged_what_the_notebook_charges(env):
    """-47.806 by the notebook's code (brax 0.14.2, MJX 3.17), whose feet are those of a time step before: 0.01 of it."""
    found = learning.evaluate(env, lambda obs: jnp.zeros(12), jax.random.key(0), num_episodes=1)
    assert_allclose(found.returns[0], -47.806, atol=0.02)
    assert found.lengths[0] == 240
