"""Environments step as rollouts do, end for the right reason, and begin anew without a trace in the derivative."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjxgrad.envs import Environment
from mjxgrad.envs.diffrl import CartPole
from mjxgrad.rollouts import rollout
from mjxgrad.scene import load_scene
from mjxgrad.stepping import Slope
from mjxgrad.tasks import scene_path
from tests.scenes import central_difference

ACTIONS = jnp.array([[0.7], [-0.4], [0.9], [0.2]])
RAIL = 1.5  # m


class Cart(CartPole):
    """The swing-up with an end of the rail, paid for its pushes, too."""

    def rewards(self, before, action, after, memory):
        return {**super().rewards(before, action, after, memory), "push": 0.1 * action[0]}

    def is_over(self, state):
        return jnp.abs(state.qpos[0]) > RAIL


def heavier(key, scene):
    """Carts and poles of one to two times the mass."""
    return scene.with_model(body_mass=scene.model.body_mass * jax.random.uniform(key, (), minval=1, maxval=2))


@pytest.fixture(scope="module")
def cart():
    """Three actions long, so that the fourth comes after the end."""
    return Cart(load_scene(scene_path("cartpole")), frame_skip=2, episode_length=3, randomisation=heavier)


@pytest.fixture(scope="module")
def state(cart):
    return jax.jit(lambda key: cart.reset(key))(jax.random.key(3))


@pytest.fixture(scope="module")
def step(cart):
    return jax.jit(lambda state, action: cart.step(state, action))


@pytest.fixture(scope="module")
def going_on(cart):
    """Where a step led, where the next one begins, and the derivatives of both states by the action."""

    @jax.jit
    def both(state, action):
        def physics(action):
            ended, following = cart.step_on(state, action)
            return [(x.physics.qpos, x.physics.qvel, x.obs) for x in (ended, following)], (ended, following)

        _, slopes, states = jax.jvp(physics, (action,), (jnp.ones_like(action),), has_aux=True)
        return states, [jnp.concatenate([jnp.ravel(x) for x in slope]) for slope in slopes]

    return both


def placed(state, *, qpos=None, qvel=None, num_steps=0):
    """The same with other physics and another count."""
    parts = {name: jnp.array(x) for name, x in (("qpos", qpos), ("qvel", qvel)) if x is not None}
    physics = dataclasses.replace(state.physics, **parts)
    return dataclasses.replace(state, physics=physics, num_steps=jnp.array(num_steps, jnp.int32))


def test_steps_are_those_of_a_rollout_of_the_controls(cart, state, step):
    """To the order of additions: a scan of two steps, twice, is compiled apart from one of four."""
    controls = jnp.repeat(jax.vmap(cart.control)(ACTIONS[:2]), 2, axis=0)
    course = jax.jit(lambda start: rollout(cart.scene, start, controls, contact=cart.contact))(state.physics)
    first = step(state, ACTIONS[0])
    second = step(first, ACTIONS[1])
    for index, reached in ((2, first), (4, second)):
        np.testing.assert_allclose(reached.physics.qpos, course.qpos[index], rtol=1e-13)
        np.testing.assert_allclose(reached.physics.qvel, course.qvel[index], rtol=1e-12)


def test_an_action_beyond_its_limits_is_the_limit(state, step):
    """For the motion and for what is paid, 0.1 for a push of 1."""
    beyond, limit = step(state, jnp.array([1.7])), step(state, jnp.array([1.0]))
    np.testing.assert_array_equal(beyond.physics.qvel, limit.physics.qvel)
    assert beyond.metrics["push"] == 0.1
    assert step(state, jnp.array([0.9])).metrics["push"] == pytest.approx(0.09)


def test_time_that_is_up_truncates_and_does_not_terminate(state, step):
    ends = []
    for action in ACTIONS[:3]:
        state = step(state, action)
        ends.append((bool(state.terminated), bool(state.truncated), bool(state.done)))
    assert ends == [(False, False, False), (False, False, False), (False, True, True)]


def test_an_end_for_good_terminates_and_is_not_truncated_even_in_the_last_step(state, step):
    for num_steps in (0, 2):
        stepped = step(placed(state, qpos=[RAIL + 0.1, 3.0], num_steps=num_steps), ACTIONS[0])
        assert stepped.terminated
        assert not stepped.truncated


def test_refined_an_action_takes_as_long_in_shorter_steps(cart, state):
    """Against C MuJoCo in steps of a quarter, eight of them for two, from the same state."""
    found = jax.jit(lambda state: cart.refined(4).with_engine("mujoco").step(state, ACTIONS[0]))(state)
    model = cart.scene.to_mujoco()
    model.opt.timestep /= 4
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.physics.qpos, state.physics.qvel
    data.ctrl[:] = cart.control(ACTIONS[0])
    mujoco.mj_step(model, data, 8)
    assert_allclose(found.physics.qpos, data.qpos, rtol=1e-12)


def test_a_state_that_diverges_ends_the_episode_and_says_so(state, step):
    """Speeds beyond 1e4 count as diverged; the state stays the last good one."""
    stepped = step(placed(state, qvel=[2e4, 0.0]), ACTIONS[0])
    assert stepped.terminated
    assert stepped.metrics["diverged"] == 1
    assert jnp.isfinite(stepped.obs).all()
    assert step(state, ACTIONS[0]).metrics["diverged"] == 0


def test_after_an_end_a_fresh_start_follows_without_a_trace_in_the_derivative(cart, state, going_on):
    (ended, following), (slope_of_end, slope_of_next) = going_on(placed(state, qpos=[RAIL + 0.1, 3.0]), ACTIONS[0])
    assert ended.terminated
    assert ended.physics.qpos[0] > RAIL
    assert following.num_steps == 0
    assert not following.done
    assert following.physics.time == 0
    # Starts are within half a metre and half a metre per second of rest.
    assert np.abs(following.physics.qpos[0]) < 0.5
    assert np.abs(following.physics.qvel).max() < 0.5
    np.testing.assert_array_equal(following.obs, cart.observe(following.physics, None))
    # Nothing after an end depends on an action before it.
    assert np.abs(slope_of_end).min() > 0
    np.testing.assert_array_equal(slope_of_next, 0.0)


def test_without_an_end_the_episode_goes_on_and_so_does_the_derivative(state, going_on):
    (ended, following), (slope_of_end, slope_of_next) = going_on(state, ACTIONS[0])
    assert not ended.done
    for now, then in zip(jax.tree.leaves(ended.physics), jax.tree.leaves(following.physics), strict=True):
        np.testing.assert_array_equal(now, then)
    assert following.num_steps == 1
    np.testing.assert_array_equal(slope_of_next, slope_of_end)
    assert np.abs(slope_of_next).min() > 0


def test_each_next_episode_begins_elsewhere(state, going_on):
    beyond = placed(state, qpos=[RAIL + 0.1, 3.0])
    (_, first), _ = going_on(beyond, ACTIONS[0])
    (_, second), _ = going_on(placed(first, qpos=[RAIL + 0.1, 3.0]), ACTIONS[0])
    assert np.abs(first.physics.qpos - second.physics.qpos).min() > 0


def test_random_copies_under_vmap_are_those_one_by_one(cart, state):
    keys = jax.random.split(jax.random.key(0), 3)
    one = jax.jit(lambda key: cart.randomised(key).step(state, ACTIONS[0]).physics.qvel)
    together = jax.jit(jax.vmap(one))(keys)
    # One factorises a batch of matrices, the other one matrix.
    np.testing.assert_allclose(together, np.stack([one(key) for key in keys]), rtol=1e-12)
    assert np.ptp(together[:, 0]) > 1e-3


def test_the_gradient_of_a_return_is_its_slope(cart, state):
    """Central differences: their error is the square of the width 1e-5, and rounding 1e-16 / 1e-5."""

    def total(actions):
        def advance(state, action):
            stepped = cart.step(state, action[None])
            return stepped, stepped.reward

        return jax.lax.scan(advance, state, actions)[1].sum()

    both = jax.jit(lambda actions: (jax.grad(total)(actions), central_difference(total, actions, 1e-5)))
    np.testing.assert_allclose(*both(ACTIONS[:, 0]), rtol=1e-7)


FELT = """<mujoco><worldbody><geom type="plane" size="2 2 .1"/><body pos="0 0 .101"><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="ball" size=".1" mass="1"/><site name="sole" pos="0 0 -.1" size=".02"/></body></worldbody>
    <actuator><motor joint="z" ctrlrange="-5 5"/></actuator>
    <sensor><framepos objtype="site" objname="sole"/><accelerometer site="sole"/></sensor></mujoco>"""


class Felt(Environment):
    """Sees where its sole is, and is paid for what it feels there under its action."""

    def observe(self, state, memory):
        return self.look(state, lambda model, data: data.sensordata)

    def rewards(self, before, action, after, memory):
        return {"felt": self.look(after, lambda model, data: data.sensordata[5], action)}


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_sensors_are_seen_and_rewarded_by_either_engine(engine):
    """As C MuJoCo reads them, in the air and after the landing; the reward's derivative is that of differences."""
    env = Felt(load_scene(FELT, engine=engine), frame_skip=10)
    start = jax.jit(lambda key: env.reset(key))(jax.random.key(0))
    actions = 0.4 + jnp.array([[-1.2], [0.0], [1e-5], [-1e-5]])

    def felt(action):
        stepped = env.step(start, action)
        return stepped.reward, stepped.obs

    (rewards, seen), slopes = jax.jit(jax.vmap(jax.value_and_grad(felt, has_aux=True)))(actions)
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(FELT))
    mujoco.mj_forward(model, data)
    assert_allclose(start.obs, data.sensordata, rtol=1e-12, atol=1e-12)
    for action, reward, obs in zip((-0.8, 0.4), rewards, seen, strict=False):
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = 5 * action
        mujoco.mj_step(model, data, 10)
        mujoco.mj_forward(model, data)
        assert_allclose(reward, data.sensordata[5], rtol=1e-8)
        data.ctrl[:] = 0
        mujoco.mj_forward(model, data)
        assert_allclose(obs, data.sensordata, rtol=1e-8, atol=1e-12)
    # Differences of C MuJoCo's sensors.
    assert_allclose(slopes[1, 0], (rewards[2] - rewards[3]) / (actions[2, 0] - actions[3, 0]), rtol=1e-5)


def test_a_state_from_another_contact_goes_on_under_a_slope():
    """Steps of MuJoCo's own derivative have no pairs of motions; an episode that ends has them no less."""
    plain = Felt(load_scene(FELT), frame_skip=2, episode_length=1)
    sloped = plain.with_contact(Slope())
    state = jax.jit(lambda key: plain.reset(key))(jax.random.key(0))
    go_on = jax.jit(lambda state, action: sloped.step_on(state, action)[1].physics.qpos)
    assert_allclose(go_on(state, jnp.zeros(1)), 0.0)
    completed = dataclasses.replace(state, physics=sloped.completed(state.physics))
    assert_allclose(go_on(completed, jnp.zeros(1)), 0.0)
