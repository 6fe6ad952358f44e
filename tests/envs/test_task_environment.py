"""A task as an environment: what an episode pays is minus what the task charges for the same controls."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.envs import from_task
from mjxgrad.rollouts import initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import SceneTask

HORIZON = 12
# A ball that falls and is steered; the lift has no range.
BALL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <geom size=".1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" ctrlrange="-1 3"/><motor name="lift" joint="z"/></actuator>
</mujoco>
"""
CONTROLS = jnp.stack([jnp.linspace(-0.8, 2.7, HORIZON), 4 * jnp.cos(jnp.arange(HORIZON))], axis=1)


def cost(trajectory):
    """All parts of a trajectory, none like another."""
    far = (trajectory.qpos[-1, 0] - 0.3) ** 2 + trajectory.qpos[HORIZON // 2, 1]
    return far + 0.1 * trajectory.final.qvel[0] + 0.01 * (trajectory.ctrl[3:] ** 2).sum() + trajectory.qvel[4, 1]


def elsewhere(key, state):
    return dataclasses.replace(state, qpos=state.qpos.at[0].add(jax.random.uniform(key)))


@pytest.fixture(scope="module")
def task():
    scene = load_scene(BALL)
    start = initial_state(scene, qvel=jnp.array([0.2, -1.0]))
    return SceneTask(scene, start, cost, HORIZON, lambda key: elsewhere(key, start))


@pytest.fixture(scope="module")
def environment(task):
    return from_task(task)


@pytest.fixture(scope="module")
def begun(environment):
    return environment.reset(jax.random.key(5))


@pytest.fixture(scope="module")
def course(environment, begun):
    """The states of an episode, and the gradient of its return."""

    def episode(controls):
        def advance(state, control):
            stepped = environment.step(state, (control - jnp.array([1.0, 0.0])) / jnp.array([2.0, 1.0]))
            return stepped, stepped

        states = jax.lax.scan(advance, begun, controls)[1]
        return states.reward.sum(), states

    (_, states), gradient = jax.jit(jax.value_and_grad(episode, has_aux=True))(CONTROLS)
    return states, gradient


@pytest.fixture(scope="module")
def charged(task, begun):
    """The task's own cost of these controls from the same start, and its gradient."""
    return jax.jit(jax.value_and_grad(lambda controls: task.run(controls, start=begun.physics).cost))(CONTROLS)


def test_the_return_is_minus_the_cost_of_the_same_controls(course, charged):
    """To rounding: the same steps, one scan or twelve."""
    np.testing.assert_allclose(course[0].reward.sum(), -charged[0], rtol=1e-12)


def test_the_gradient_of_the_return_is_minus_that_of_the_cost(course, charged):
    np.testing.assert_allclose(course[1], -charged[1], rtol=1e-12)
    assert (np.abs(course[1]) > 0).all()


def test_only_the_last_step_pays(course):
    np.testing.assert_array_equal(course[0].reward[:-1], 0.0)


def test_the_episode_ends_for_good_at_the_horizon(course):
    np.testing.assert_array_equal(course[0].terminated, np.arange(1, HORIZON + 1) == HORIZON)
    assert not course[0].truncated.any()


def test_the_policy_sees_state_and_time(course):
    states, _ = course
    elapsed = np.arange(1, HORIZON + 1)[:, None] / HORIZON
    expected = np.concatenate([states.physics.qpos, states.physics.qvel, elapsed], axis=1)
    np.testing.assert_allclose(states.obs, expected, rtol=1e-15)


def test_episodes_begin_as_the_task_draws_them(task, environment, begun):
    """The x is drawn within a metre of the nominal start, the rest is as it stands there."""
    other = environment.reset(jax.random.key(6))
    assert begun.physics.qpos[0] != other.physics.qpos[0]
    assert 0 < begun.physics.qpos[0] < 1
    np.testing.assert_array_equal(begun.physics.qvel, task.state.qvel)


def test_actions_reach_the_ends_of_a_range_and_are_the_controls_without_one(environment):
    """From −1 to 3 by the one, as they come by the other."""
    np.testing.assert_allclose(environment.control(jnp.array([1.0, 7.0])), [3.0, 7.0])
    np.testing.assert_allclose(environment.control(jnp.array([-1.0, -7.0])), [-1.0, -7.0])
    np.testing.assert_array_equal(environment.action_limit, [1.0, np.inf])


def test_an_episode_that_diverges_is_charged_as_if_all_stayed(environment, begun):
    """From the sixth step on at the place that the second reached, under the control of the sixth."""
    stepped = begun
    for _ in range(2):
        memory = environment.next_memory(stepped.memory, jnp.zeros(2), stepped.physics, jax.random.key(0))
        stepped = dataclasses.replace(stepped, memory=memory)
    stays = environment.rewards(stepped.physics, jnp.array([0.5, 2.0]), stepped.physics, stepped.memory)
    qpos, qvel = stepped.physics.qpos, stepped.physics.qvel
    controls = 9 * (2.0**2 + 2.0**2)  # from step 3 on: half of the range is 2
    expected = (qpos[0] - 0.3) ** 2 + qpos[1] + 0.1 * qvel[0] + 0.01 * controls + qvel[1]
    np.testing.assert_allclose(stays["cost"], -expected, rtol=1e-14)


def test_costs_of_observations_are_refused(task):
    with pytest.raises(ValueError, match="task must have a cost of positions, velocities and controls"):
        from_task(dataclasses.replace(task, observe=lambda model, data: data.qpos))
