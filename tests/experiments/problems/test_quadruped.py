"""The quadruped: what standing is worth, pushes, and when it has fallen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjxgrad as mg
from experiments.problems.quadruped import MOST_COMMAND, quadruped


@pytest.fixture(scope="module")
def robot():
    return dataclasses.replace(quadruped(), randomisation=None)


def test_who_stands_still_earns_more_than_who_falls(robot):
    """Charged are the squared commands, in the mean a third of their largest; else a policy would learn to fall at once."""
    rest = mg.initial_state(robot.scene)
    terms = robot.rewards(rest, jnp.zeros(12), rest, {"command": jnp.array(MOST_COMMAND), "action": jnp.zeros(12)})
    assert_allclose(terms["speed"] + terms["turning"], -(np.array(MOST_COMMAND) ** 2).sum(), rtol=1e-6)
    mean = sum(float(value) for name, value in terms.items() if name not in ("speed", "turning"))
    mean -= (np.array(MOST_COMMAND) ** 2).sum() / 3
    assert mean > 1


def test_a_push_changes_the_speed_once(robot):
    """Every 200 actions in the mean, of 2000 draws 10 ± 3; at most 1 m/s along either axis."""
    rest = mg.initial_state(robot.scene)
    memory = robot.first_memory(jax.random.key(0))
    assert_allclose(robot.disturbed(rest, memory).qvel, rest.qvel)
    draw = jax.vmap(lambda key: robot.next_memory(memory, jnp.zeros(12), rest, key)["push"])
    pushes = np.asarray(draw(jax.random.split(jax.random.key(1), 2000)))
    assert 1 <= (np.abs(pushes).max(axis=1) > 0).sum() <= 22
    assert np.abs(pushes).max() <= 1
    pushed = robot.disturbed(rest, memory | {"push": jnp.array([0.5, -0.2])})
    assert_allclose(pushed.qvel - rest.qvel, [0.5, -0.2, *np.zeros(16)], atol=1e-7)


def test_it_is_over_when_it_lies_or_has_rolled_over(robot):
    rest = mg.initial_state(robot.scene)
    assert not robot.is_over(rest)
    assert robot.is_over(dataclasses.replace(rest, qpos=rest.qpos.at[2].set(0.1)))
    half = jnp.array([np.cos(1.0), np.sin(1.0), 0, 0])
    assert robot.is_over(dataclasses.replace(rest, qpos=rest.qpos.at[3:7].set(half)))
