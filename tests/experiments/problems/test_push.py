"""The published push with MuJoCo's contact."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.problems.push import push, push_softness
from mjxgrad.rollouts import rollout

TIMESTEP, MASS, RAIL_DAMPING = 0.005, 0.1, 0.04  # s, kg, N s/m: of the push
PULLED = jnp.ones((12, 1))  # N


@pytest.fixture(scope="module")
def pushed():
    """From stiffness, forces and positions to velocities."""
    task = push(horizon=12)

    @jax.jit
    def course(stiffness, forces, qpos):
        start = eqx.tree_at(lambda state: state.qpos, task.state, qpos)
        return rollout(task.with_softness(push_softness(stiffness)).scene, start, forces).qvel

    return course


@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_contact_passes_momentum_on_and_neither_makes_nor_loses_any(pushed, stiffness):
    """The sum of the momenta obeys p ← (p + h u) / (1 + h c / m), the rail's damping being implicit."""
    qvel = pushed(stiffness, 0.5 * PULLED, jnp.zeros(2))
    expected = np.zeros(13)
    for t in range(12):
        expected[t + 1] = (expected[t] + TIMESTEP * 0.5) / (1 + TIMESTEP * RAIL_DAMPING / MASS)
    np.testing.assert_allclose(MASS * np.asarray(qvel).sum(axis=1), expected, rtol=1e-8)
    assert qvel[-1, 1] > 1e-3


@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_a_deep_contact_pushes_with_stiffness_times_depth(pushed, stiffness):
    """At rest, 2 mm deep, twice the depth at which the impedance is full; no other acceleration to take a share off."""
    qvel = pushed(stiffness, 0 * PULLED, jnp.array([0.002, 0.0]))
    force = MASS * qvel[1, 1] * (1 + TIMESTEP * RAIL_DAMPING / MASS) / TIMESTEP
    # The solver stops at a relative improvement of 1e-8.
    np.testing.assert_allclose(force, stiffness * 0.002, rtol=1e-5)
