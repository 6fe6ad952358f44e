"""What DiffRL's tasks see, pay and end, against numbers worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.envs import diffrl
from mjxgrad.rollouts import initial_state

# Turned by 0.4 about the vertical, then by 0.3 about the own y: R = Rz(0.4) Ry(0.3).
LEAN, TURN = 0.3, 0.4
(_CT, _CL), (_ST, _SL) = (function(np.array([TURN, LEAN]) / 2) for function in (np.cos, np.sin))
QUATERNION = np.array([_CT * _CL, -_ST * _SL, _CT * _SL, _ST * _CL])
UPRIGHT = np.cos(LEAN)  # the z of the own z
HEADING = np.cos(TURN) * np.cos(LEAN)  # the x of the own x


@pytest.fixture(scope="module")
def ant():
    return diffrl.ant()


@pytest.fixture(scope="module")
def hopper():
    return diffrl.hopper()


def floating(environment, height):
    """A state with all numbers different, and its velocities and joints."""
    model = environment.scene.model
    middle = model.jnt_range[1:].mean(axis=1)
    joints, qvel = middle + 0.01 * np.arange(1, model.nq - 6), 0.1 * np.arange(1, model.nv + 1)
    qpos = np.concatenate([[5.0, 6.0, height], QUATERNION, joints])
    return initial_state(environment.scene, jnp.array(qpos), jnp.array(qvel)), qvel, joints


def rewards(environment, state, action=None):
    action = jnp.zeros(environment.num_actions) if action is None else action
    memory = environment.first_memory(jax.random.key(0))
    return {name: float(x) for name, x in environment.rewards(state, action, state, memory).items()}


def test_the_cart_pole_pays_for_angle_place_and_speeds():
    """Of 3 π / 2, a quarter turn from upright; π² / 4 + 0.1 · 2² and 0.05 · 0.5² + 0.1 · 3²."""
    swing = diffrl.cartpole()
    state = initial_state(swing.scene, jnp.array([0.5, 1.5 * np.pi]), jnp.array([3.0, 2.0]))
    terms = rewards(swing, state)
    np.testing.assert_allclose(terms["pole"], -(np.pi**2 / 4 + 0.4), rtol=1e-14)
    np.testing.assert_allclose(terms["cart"], -(0.0125 + 0.9), rtol=1e-14)
    np.testing.assert_allclose(swing.observe(state, None), [0.5, 3.0, -1.0, 0.0, 2.0], atol=1e-15)


def test_the_ant_sees_its_base_joints_course_and_last_action(ant):
    state, qvel, joints = floating(ant, height=0.5)
    action = np.linspace(-0.5, 0.4, 8)
    seen = ant.observe(state, {"action": jnp.array(action)})
    expected = [[0.5], QUATERNION, qvel[:6], joints, 0.1 * qvel[6:], [UPRIGHT, HEADING], action]
    assert seen.shape == (37,)
    np.testing.assert_allclose(seen, np.concatenate(expected), rtol=1e-14)


def test_the_ant_is_paid_for_speed_posture_and_height(ant):
    """Along x at 0.1 m/s, 0.5 m − 0.27 m high; actions are free."""
    state, *_ = floating(ant, height=0.5)
    terms = rewards(ant, state, jnp.ones(8))
    expected = {"forward": 0.1, "upright": 0.1 * UPRIGHT, "heading": HEADING, "height": 0.23, "action": 0.0}
    assert terms == pytest.approx(expected, rel=1e-13)


def test_the_ant_is_over_below_27_cm_and_the_hopper_45_cm_lower(ant, hopper):
    assert [bool(ant.is_over(floating(ant, height)[0])) for height in (0.26, 0.28, 3.0)] == [True, False, False]
    poses = (hopper.scene.data.qpos.at[1].add(-lowered) for lowered in (0.44, 0.46))
    assert [bool(hopper.is_over(initial_state(hopper.scene, qpos))) for qpos in poses] == [False, True]


@pytest.mark.parametrize(
    ("height", "paid"),
    [
        (0.79, -200 * 0.05**2),  # 5 cm below the wanted 0.84 m
        (0.89, 10 * 0.05),
        (1.4, 10 * 0.1),  # no more than for 10 cm
    ],
)
def test_the_humanoid_is_paid_for_height_and_charged_for_actions(height, paid):
    """Seventeen actions of 0.5 at 0.002 per square."""
    humanoid = diffrl.humanoid()
    state, *_ = floating(humanoid, height)
    terms = rewards(humanoid, state, jnp.full(17, 0.5))
    expected = {"upright": 0.1 * UPRIGHT, "heading": HEADING, "height": paid, "action": -0.002 * 17 * 0.25}
    assert terms == pytest.approx({"forward": 0.1, **expected}, rel=1e-12)
    assert humanoid.observe(state, {"action": jnp.zeros(17)}).shape == (1 + 4 + 6 + 17 + 17 + 2 + 17,)


@pytest.mark.parametrize(
    ("lowered", "paid"),
    [
        (0.4, -200 * 0.1**2),  # 10 cm below the wanted 0.3 m under the rest pose
        (0.2, 0.1),
        (-0.1, 0.3),  # no more than for 30 cm
    ],
)
def test_the_hopper_is_paid_for_speed_height_and_an_upright_torso(hopper, lowered, paid):
    """At 2 m/s, bent by a fifth of 30°; three actions of 0.5 at 0.1 per square."""
    rest = hopper.scene.data.qpos[1]
    qpos = jnp.array([4.0, rest - lowered, np.pi / 30, -0.1, -0.2, 0.3])
    state = initial_state(hopper.scene, qpos, jnp.array([2.0, -1.0, 0.5, 0.1, 0.2, 0.3]))
    expected = {"forward": 2.0, "height": paid, "upright": 1 - 0.04, "action": -0.1 * 0.75}
    assert rewards(hopper, state, jnp.full(3, 0.5)) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_array_equal(hopper.observe(state, None), np.concatenate([qpos[1:], state.qvel]))


def test_the_cheetah_is_paid_for_speed_alone_and_never_over():
    cheetah = diffrl.half_cheetah()
    qpos = jnp.zeros(9).at[1].set(-5.0)
    state = initial_state(cheetah.scene, qpos, jnp.arange(9) + 2.0)
    assert rewards(cheetah, state, jnp.full(6, 0.5)) == pytest.approx({"forward": 2.0, "action": -0.15}, rel=1e-14)
    assert not cheetah.is_over(state)


@pytest.mark.parametrize("name", ["ant", "cartpole", "half_cheetah", "hopper", "humanoid"])
def test_an_action_holds_for_a_sixtieth_of_a_second(name):
    np.testing.assert_allclose(getattr(diffrl, name)().interval, 1 / 60, rtol=1e-7)
