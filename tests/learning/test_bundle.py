"""Bundled gradients: the motion as it is, the mean of its neighbours' derivatives where contact pushes hard."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjxgrad as mg
from mjxgrad import envs
from mjxgrad.learning import Bundle
from mjxgrad.learning.networks import Network, Normaliser
from mjxgrad.learning.window import window_gradients

WEIGHT = 2 * 9.81  # N


class Ball(envs.Environment):
    """A ball that is lifted or pressed down, and earns its height and speed."""

    scene: mg.Scene

    def observe(self, state, memory):
        return jnp.concatenate([state.qpos, state.qvel])

    def rewards(self, before, action, after, memory):
        return {"height": jnp.sin(30 * after.qpos[0]), "speed": after.qvel[0] ** 2}


@pytest.fixture(scope="module")
def ball():
    return Ball(
        mg.load_scene("""<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .1">
        <joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="2" condim="1" priority="1"/></body></worldbody>
        <actuator><motor joint="z" ctrlrange="-1 1"/></actuator></mujoco>"""),
        frame_skip=3,
    )


@functools.cache
def program(environment_id, bundle):
    """Return a program from a height and a speed to what a step gives and earns, and to the derivative of their mix."""
    environment = ENVIRONMENTS[environment_id]
    step_on = environment.step_on if bundle is None else functools.partial(bundle.step_on, environment)

    def outcome(start):
        state = environment.reset(jax.random.key(5))
        physics = mg.initial_state(environment.scene, start[:1], start[1:])
        stepped, following = step_on(dataclasses.replace(state, physics=physics), jnp.array([0.3]))
        values = jnp.stack([stepped.reward, stepped.physics.qvel[0], following.obs[0], stepped.obs[1]])
        return values @ jnp.array([1.0, 0.7, 30.0, -0.4]), values

    return jax.jit(jax.grad(outcome, has_aux=True))


ENVIRONMENTS = {}


def at(environment, bundle, height, speed):
    """Return the derivative and the values."""
    ENVIRONMENTS["ball"] = environment
    return jax.tree.map(np.asarray, program("ball", bundle)(jnp.array([height, speed])))


# Heights (m): deep in the floor, which pushes by 16 weights; at rest on it, and far off it.
DEEP, RESTING, AIR = -1e-2, -2e-4, 0.3
BUNDLE = Bundle(num_branches=6, force=4 * WEIGHT)


def test_the_derivative_is_the_mean_of_those_at_the_branches(ball):
    """Each by itself, from the starts that the state's third key draws; some of them are above the floor."""
    slope, values = at(ball, BUNDLE, DEEP, -0.1)
    keys = jax.random.split(jax.random.split(ball.reset(jax.random.key(5)).key, 3)[2], 6)
    changes = [np.asarray(jax.random.normal(key, (2, 1)))[:, 0] for key in keys]
    each = [at(ball, None, DEEP + 0.01 * turn, -0.1 + 0.02 * push)[0] for turn, push in changes]
    assert_allclose(slope, np.mean(each, axis=0), rtol=1e-10)
    assert np.std(each, axis=0).min() > 0.1
    assert_allclose(values, at(ball, None, DEEP, -0.1)[1], rtol=1e-12)


@pytest.mark.parametrize(("height", "speed"), [(AIR, -0.1), (RESTING, 0.0)])
def test_the_derivative_is_plain_where_contact_does_not_push_hard(ball, height, speed):
    """Far off the floor nothing pushes, and at rest on it the weight does."""
    assert_allclose(at(ball, BUNDLE, height, speed)[0], at(ball, None, height, speed)[0], rtol=1e-10)


def test_a_foot_that_lands_within_the_step_counts(ball):
    """At 4 mm above the floor and 3 m/s towards it, it is in the floor after 6 ms, and nothing pushes before."""
    assert not np.allclose(at(ball, BUNDLE, 4e-3, -3.0)[0], at(ball, None, 4e-3, -3.0)[0], rtol=1e-3)


@pytest.mark.slow
def test_without_spread_it_is_the_plain_one(ball):
    bundle = Bundle(num_branches=3, position_stddev=0.0, velocity_stddev=0.0, force=0.0)
    assert_allclose(at(ball, bundle, DEEP, -0.1)[0], at(ball, None, DEEP, -0.1)[0], rtol=1e-10)


def test_windows_step_by_it(ball):
    """One whose steps have no derivative leaves none of the window's return; zeroth order needs none."""

    class Constant(Bundle):
        def step_on(self, environment, state, action):
            return jax.lax.stop_gradient(environment.step_on(state, action))

    actor = Network.make((2, 4, 1), jax.random.key(1), final_scale=1.0)
    networks, noise = (actor, lambda seen: seen[0], Normaliser.make(2)), jnp.array([[0.4], [-1.2]])
    state, key = ball.reset(jax.random.key(5)), jax.random.key(0)
    found = jax.jit(
        lambda: window_gradients(ball, state, key, noise, *networks, jnp.array(0.3), 0.9, bundle=Constant())[2]
    )()
    assert_array_equal(found.first, 0)
    assert np.all(found.zeroth != 0)


def test_what_cannot_be_a_bundle_is_refused():
    with pytest.raises(ValueError, match="num_branches must be"):
        Bundle(num_branches=0)
    with pytest.raises(ValueError, match="must not be negative"):
        Bundle(force=-1.0)
