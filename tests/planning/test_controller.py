"""Control by receding horizon: poles that must stand, the clock, and where each decision begins."""

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.planning import Controller, Exact, FunctionSystem, GoalCost, SceneSystem, optimise_trajectory, shifted

START, HORIZON = np.array([1.0, -0.5]), 8
COST = GoalCost(jnp.zeros(2), 1.0, 10.0, 0.1)


def pendulum(state, control):
    speed = state[1] + 0.1 * (jnp.sin(state[0]) + control[0])
    return jnp.stack([state[0] + 0.1 * speed, speed])


@pytest.fixture(scope="module")
def controller():
    """One of a pendulum, whose later decisions have never time for an iteration."""
    system, controls = FunctionSystem(pendulum, 2, 1), jnp.full((HORIZON, 1), 0.1)
    return Controller(system, COST, controls, schedule=[1.0, 1.0], first_schedule=np.ones(5), deadline=1e-9, upper=2.0)


@pytest.fixture(scope="module")
def balance():
    """The environment of a cart with a pole, and a controller of it."""
    env = gymnasium.make("InvertedPendulum-v5")
    scene, weight = mg.load_scene(env.unwrapped.model), jnp.array([1.0, 10.0, 0.1, 0.1])  # pyright: ignore
    system = SceneSystem(scene=scene, num_substeps=env.unwrapped.frame_skip)  # pyright: ignore
    return env, Controller(system, GoalCost(jnp.zeros(4), weight, 10 * weight, 0.01), jnp.zeros((15, 1)), deadline=10.0)


def test_a_pole_stands_after_a_hundred_decisions_that_compile_nothing(balance, compilations):
    env, controller = balance
    controller.reset()
    model, data = env.unwrapped.model, mujoco.MjData(env.unwrapped.model)
    data.qpos[1] = 0.4  # rad
    for _ in range(100):
        data.ctrl[:] = controller(data)
        mujoco.mj_step(model, data, 2)
    assert not compilations
    assert np.abs(np.concatenate([data.qpos, data.qvel])).max() < 0.02
    assert (len(controller.seconds), controller.num_late, controller.num_cut) == (100, 0, 0)
    assert str(controller).startswith("100 decisions, ")
    assert " 0 later than 1e4 ms; compiled once, in " in str(controller).replace("10000", "1e4")


def test_gymnasiums_pole_stands_by_controls_from_its_data(balance):
    env, controller = balance
    controller.reset()
    env.reset(seed=0)
    ended = [env.step(controller(env.unwrapped.data).astype(np.float32))[2] for _ in range(50)]
    assert not any(ended)
    assert abs(env.unwrapped.data.qpos[1]) < 0.01


def test_a_first_decision_is_the_plan_of_its_schedule(controller):
    controller.reset()
    plan = optimise_trajectory(
        controller.system, COST, START, jnp.full((HORIZON, 1), 0.1), jax.random.key(0), smoother=Exact(),
        schedule=np.ones(5), upper=2.0,
    )  # fmt: skip
    np.testing.assert_allclose(controller(START), plan.controls[0], atol=1e-12)
    np.testing.assert_allclose(controller.plan.states, plan.states, atol=1e-12)
    assert (controller.num_late, controller.num_cut) == (0, 0)


def test_without_time_a_decision_is_the_shifted_plan_and_counts_as_late(controller):
    controller.reset()
    controller(START)
    for count in (1, 2):
        before, state = shifted(controller.plan), controller.plan.states[1]
        np.testing.assert_array_equal(controller(state), before[0])
        np.testing.assert_array_equal(controller.plan.controls, before)
        assert (controller.num_late, controller.num_cut) == (count, count)
    assert "2 later than 1e-6 ms, 2 cut" in str(controller)


def test_a_reset_controller_decides_as_at_first(controller):
    controller.reset()
    first = controller(START)
    assert controller(START) != first
    controller.reset()
    assert controller.seconds == []
    assert controller(START) == first


def test_a_moved_goal_is_planned_for_and_compiles_nothing(controller, compilations):
    moved = GoalCost(jnp.array([2.0, 0.0]), 1.0, 10.0, 0.1)
    controller.reset()
    before, controller.cost = controller(START), moved
    num_compiled = len(compilations)
    controller.reset()
    assert controller(START) > before + 0.5
    assert len(compilations) == num_compiled
    controller.cost = COST


def test_a_scene_is_planned_by_c_mujoco_as_by_mjx():
    """A box that slides on a floor under Coulomb friction, two steps of 10 ms: end and linear model."""
    scene = mg.load_scene(
        "<mujoco><option timestep='.01' tolerance='1e-12'/><worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 .099'>"
        "<joint type='slide' axis='1 0 0' name='x'/><joint type='slide' axis='0 0 1'/><geom size='.1'/></body></worldbody>"
        "<actuator><motor joint='x'/></actuator></mujoco>"
    )
    state, control = jnp.array([0.1, 0.0, 1.0, 0.0]), jnp.array([0.5])
    found = []
    for engine in ("mujoco", "mjx"):
        system = SceneSystem(scene=scene, num_substeps=2, contact=mg.Discrete(engine))  # pyright: ignore[reportCallIssue]
        found.append(Exact().linear_model(system, state, control, jax.random.key(0)))
    np.testing.assert_allclose(found[0].c, found[1].c, atol=1e-8)
    np.testing.assert_allclose(found[0].A, found[1].A, atol=1e-4)
    np.testing.assert_allclose(found[0].B, found[1].B, atol=1e-4)
