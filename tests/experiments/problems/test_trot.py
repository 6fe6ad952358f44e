"""The trot on ANYmal: the robot against published numbers and rest in C MuJoCo, the task against formulas in numpy."""

import functools

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


def test_the_robot_is_its_own_image_when_turned_by_half_and_when_mirrored(model):
    """Turned, to rounding: diagonal legs are the same parts. Mirrored about y = 0, but for 0.2 mm and 0.3 g m² of the drives."""
    data = mujoco.MjData(model)
    data.qpos[3] = 1
    left, right = np.array([0.1, 0.6, -0.9]), np.array([-0.1, 0.6, -0.9])
    data.qpos[7:] = np.concatenate([left, right, -right, -left])
    mujoco.mj_kinematics(model, data)
    turned, mirrored = np.diag([-1, -1, 1]), np.diag([1, -1, 1])
    images = [(("LF", "RH"), turned, 2e-6), (("RF", "LH"), turned, 2e-6), (("LF", "RF"), mirrored, 3e-4)]
    for legs, image, tolerance in images:
        for part in ("hip", "thigh", "shank"):
            first, second = (model.body(f"{leg}_{part}").id for leg in legs)
            assert_allclose(data.xipos[first], image @ data.xipos[second], atol=tolerance)
            assert_allclose(_inertia(model, data, first), image @ _inertia(model, data, second) @ image, atol=tolerance)


def _inertia(model, data, body):
    turn = data.ximat[body].reshape(3, 3)
    return turn @ np.diag(model.body_inertia[body]) @ turn.T


def foot_height(hip, knee):
    """Height of a front foot's centre above the base (m) from the lengths of thigh and shank; abduction is zero.

    A positive angle moves a foot back. The hip's axis is as high as the base.
    """
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


@pytest.mark.parametrize("num_actions", [0, 5, 13, 26 + 17])
def test_the_reward_is_the_distance_from_the_gait(env, model, num_actions):
    """Of joints and base before the action and of the feet after it, whose places are C MuJoCo's."""
    before, after = state_of(env, 1), state_of(env, 2)
    memory = {"num_actions": jnp.array(num_actions), "targets": jnp.zeros(12)}
    terms = env.rewards(before, jnp.zeros(12), after, memory)
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
    """-47.806 is the return of the notebook's own code (brax 0.14.2, MJX 3.17, one solver iteration) on this robot, actions zero.

    Its feet are those of one time step before: a difference of 0.01.
    """
    found = learning.evaluate(env, lambda obs: jnp.zeros(12), jax.random.key(0), num_episodes=1)
    assert_allclose(found.returns[0], -47.806, atol=0.02)
    assert found.lengths[0] == 240


def test_derivatives_along_three_actions_are_those_of_differences(env, key):
    """Of the return, by the actions, in three directions, on copies of the environment side by side."""
    actions = 0.3 * jax.random.normal(key, (3, 12))

    def returned(actions):
        def advance(state, action):
            state = env.step(state, action)
            return state, (state.reward, state.memory)

        return jax.lax.scan(advance, env.reset(key), actions)[1]

    directions = jax.random.normal(jax.random.key(1), (3, 3, 12))
    h = 3e-6  # rounding in the solve leaves 1e-10 of a return unknown; at 1e-5 it is the third derivative that shows
    around = actions + h * jnp.concatenate([jnp.zeros((1, 3, 12)), directions, -directions])
    values, slopes, memory = _along(returned, around)
    differences = (values[1:4] - values[4:]) / (2 * h)
    assert_allclose(jnp.einsum("ta,dta->d", slopes[0], directions), differences, rtol=1e-4)
    # Actions move the targets of hips and knees by 0.8 rad and of abductions by 0.2.
    reach = np.tile([0.2, 0.8, 0.8], 4)
    assert_allclose(memory["targets"][0, -1], STANCE + reach * actions[-1], atol=1e-7)
    assert memory["num_actions"][0, -1] == 3


@functools.partial(jax.jit, static_argnums=0)
def _along(returned, actions):
    def one(actions):
        rewards, memory = returned(actions)
        return rewards.sum(), memory

    (values, memory), slopes = jax.vmap(jax.value_and_grad(one, has_aux=True))(actions)
    return values, slopes, memory
