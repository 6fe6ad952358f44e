"""Gymnasium's robots see, earn and end what gymnasium's own do in the same states."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.problems.gymnasium_v5 import own_robot
from mjxgrad.envs import load
from mjxgrad.rollouts import initial_state

ROBOTS = ("hopper", "half_cheetah", "walker2d", "ant", "humanoid")
LIFT = 0.9  # m: beyond the heights at which walker, ant and humanoid are healthy


def _theirs(name, num_episodes=4, num_steps=15):
    """Step gymnasium's robot at random, beyond ends, two episodes from the air: all it told, and states before and after."""
    robot = own_robot(name).unwrapped
    data, random, rows = robot.data, np.random.default_rng(0), []
    simulate = robot.do_simulation

    def up_to_date(*args):
        # MuJoCo leaves places of bodies as they were before its last step, which ant and humanoid read. A robot's speed is
        # between the states that it says it is in, so they are brought up to date.
        simulate(*args)
        mujoco.mj_kinematics(robot.model, data)

    robot.do_simulation = up_to_date
    for episode in range(num_episodes):
        robot.reset(seed=episode)
        qpos = data.qpos.copy()
        qpos[1 if name in ("hopper", "half_cheetah", "walker2d") else 2] += LIFT * (episode % 2)
        robot.set_state(qpos, data.qvel.copy())
        for _ in range(num_steps):
            before = data.qpos.copy(), data.qvel.copy()
            action = random.uniform(-1, 1, robot.model.nu)
            obs, reward, over, _, info = robot.step(action * robot.model.actuator_ctrlrange[:, 1])
            rows.append((before, action, (data.qpos.copy(), data.qvel.copy()), obs, reward, over, info))
    robot.close()
    return rows


@pytest.fixture(scope="module", params=ROBOTS)
def both(request):
    """What gymnasium's robot told, and what ours makes of the same states."""
    rows = _theirs(request.param)
    before, action, after, obs, reward, over, info = zip(*rows, strict=True)
    ours = load(request.param)

    def tell(before, action, after):
        then, now = initial_state(ours.scene, *before), initial_state(ours.scene, *after)
        return ours.observe(now, None), ours.rewards(then, action, now, None), ours.is_over(now)

    stacked = (
        tuple(map(np.stack, zip(*before, strict=True))),
        np.stack(action),
        tuple(map(np.stack, zip(*after, strict=True))),
    )
    told = jax.jit(jax.vmap(tell))(*jax.tree.map(jnp.asarray, stacked))
    terms = {
        key: np.array([x.get(key, 0.0) for x in info]) for key in ("reward_forward", "reward_ctrl", "reward_survive")
    }
    return request.param, (np.stack(obs), np.array(reward), np.array(over), terms), told


def test_observations_rewards_and_ends_are_theirs(both):
    """A speed is a difference of places of about 1 m over 8 ms at least: rounding is 1e-16 / 8e-3."""
    name, (obs, reward, over, terms), (seen, rewards, is_over) = both
    np.testing.assert_array_equal(seen, obs)
    for ours, theirs in (("forward", "forward"), ("control", "ctrl"), ("alive", "survive")):
        np.testing.assert_allclose(rewards[ours], terms[f"reward_{theirs}"], rtol=1e-13, atol=1e-13, err_msg=ours)
    np.testing.assert_allclose(sum(rewards.values()), reward, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(is_over, over)
    if name != "half_cheetah":
        assert over.any()
        assert not over.all()


def test_a_hopper_out_of_all_range_is_over():
    """100 rad/s of a joint, at a pose that is healthy."""
    ours = load("hopper")
    speed = jnp.zeros(6).at[5].set(99.0)
    is_over = [bool(ours.is_over(initial_state(ours.scene, qvel=x))) for x in (speed, 1.02 * speed)]
    assert is_over == [False, True]
