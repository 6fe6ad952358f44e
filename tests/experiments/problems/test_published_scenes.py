"""The published stories with real contact."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.problems.published_scenes import friction, motion_planning, push, push_softness, tennis
from mjxgrad.rollouts import rollout
from mjxgrad.tasks import scene_path

TIMESTEP, MASS, RAIL_DAMPING = 0.005, 0.1, 0.04  # s, kg, N s/m: of the push
COEFFICIENT, GRAVITY = 0.1835, 9.81  # of the friction; m/s²
TOUCHING, APART = jnp.zeros(2), jnp.array([-0.5, 0.0])
PULLED = jnp.ones((12, 1))  # N: far more than friction passes on


@pytest.mark.parametrize("make", [push, friction, motion_planning, tennis])
def test_a_scene_loads_without_a_warning_and_its_start_fits(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        task = make(horizon=3)
    assert task.initial_params().shape == (task.objective().dim,)


def test_random_starts_have_the_shape_of_the_nominal_one(key):
    task = tennis(horizon=3)
    nominal, drawn = task.nominal_start(), task.sample_start(key)
    assert jax.tree.map(jnp.shape, nominal) == jax.tree.map(jnp.shape, drawn)
    np.testing.assert_allclose(task.policy.observe(drawn), task.start_distribution.task.sample_start(key))


@pytest.fixture(scope="module")
def pushed():
    """From stiffness, forces and positions to the cost, its derivative by the forces, and velocities."""
    task = push(horizon=12)

    @jax.jit
    def course(stiffness, forces, qpos):
        def cost(forces):
            start = eqx.tree_at(lambda state: state.qpos, task.state, qpos)
            trajectory = rollout(task.with_softness(push_softness(stiffness)).scene, start, forces)
            return task.cost(trajectory).sum(), trajectory.qvel

        return jax.value_and_grad(cost, has_aux=True)(forces)

    return course


@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_contact_passes_momentum_on_and_neither_makes_nor_loses_any(pushed, stiffness):
    """The sum of the momenta obeys p ← (p + h u) / (1 + h c / m), the rail's damping being implicit."""
    (_, qvel), _ = pushed(stiffness, 0.5 * PULLED, TOUCHING)
    expected = np.zeros(13)
    for t in range(12):
        expected[t + 1] = (expected[t] + TIMESTEP * 0.5) / (1 + TIMESTEP * RAIL_DAMPING / MASS)
    np.testing.assert_allclose(MASS * np.asarray(qvel).sum(axis=1), expected, rtol=1e-8)
    assert qvel[-1, 1] > 1e-3


@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_a_deep_contact_pushes_with_stiffness_times_depth(pushed, stiffness):
    """At rest, 2 mm deep, twice the depth at which the impedance is full; no other acceleration to take a share off."""
    (_, qvel), _ = pushed(stiffness, 0 * PULLED, jnp.array([0.002, 0.0]))
    force = MASS * qvel[1, 1] * (1 + TIMESTEP * RAIL_DAMPING / MASS) / TIMESTEP
    # The solver stops at a relative improvement of 1e-8.
    np.testing.assert_allclose(force, stiffness * 0.002, rtol=1e-5)


@pytest.fixture(scope="module")
def dragged():
    """From forces to the cost, its derivative by them, and velocities."""
    task = friction(horizon=12)

    @jax.jit
    def course(forces):
        def cost(forces):
            trajectory = rollout(task.scene, task.state, forces)
            return task.cost(trajectory).sum(), trajectory.qvel

        return jax.value_and_grad(cost, has_aux=True)(forces)

    return course


def test_a_sliding_puck_gains_the_coefficient_times_the_impulse_that_carries_it(dragged):
    """M vₓ = μ Σ h fₙ and m v_z = Σ h (fₙ − m g), so vₓ = μ (g t + v_z), while it sinks in as well as at rest."""
    (_, qvel), _ = dragged(PULLED)
    time = TIMESTEP * np.arange(4, 13)
    gained = np.asarray(qvel[4:, 1] - qvel[4, 1])
    fallen = np.asarray(qvel[4:, 2] - qvel[4, 2])
    np.testing.assert_allclose(gained, COEFFICIENT * (GRAVITY * (time - time[0]) + fallen), rtol=1e-5, atol=1e-9)


@pytest.fixture(scope="module")
def simulated():
    """From a scene, a start, constant controls and a number of steps to positions and velocities, in C MuJoCo."""

    def course(name, qpos, qvel, ctrl, num_steps):
        model = mujoco.MjModel.from_xml_path(str(scene_path(name)))
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        states = []
        for _ in range(num_steps):
            mujoco.mj_step(model, data)
            states.append((data.qpos.copy(), data.qvel.copy()))
        return [np.stack(column) for column in zip(*states, strict=True)]

    return course


@pytest.mark.parametrize("speed", [0.2, 0.4, 0.8])
@pytest.mark.parametrize("height", [0.5, 0.51])
def test_a_pad_returns_the_ball_with_its_speed_and_is_not_passed_through(simulated, speed, height):
    """A bounce of an undamped spring takes half a period; ten steps are exact to a few per cent, whatever the phase."""
    qpos, qvel = simulated("tennis", [0, height, 0, 0, 0], [0, -speed, 0, 0, 0], 0, int(1.2 / speed / 0.05))
    np.testing.assert_allclose(qvel[-1, 1], speed, rtol=0.03)
    assert qpos[:, 1].min() > 0.05


@pytest.mark.parametrize("speed", [1.0, 4.0, 8.0])
def test_no_speed_takes_the_robot_through_a_pillar(simulated, speed):
    """Pressed at a pillar it rests at depth (1 − d) u / (h k), with d = 0.95 and k = 900/s²."""
    qpos, _ = simulated("motion_planning", [0, 1.0], 0, [0, speed], 100)
    np.testing.assert_allclose(qpos[-1], [0, 1.3 + 0.05 * speed / (0.02 * 900)], atol=1e-6)
    assert qpos[:, 1].max() < 1.33
