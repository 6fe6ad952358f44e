"""Control by receding horizon: a pole that must stand, the clock, and where each decision begins."""

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.planning import Controller, Exact, FunctionSystem, GoalCost, SceneSystem, optimise_trajectory

START, GIVEN = np.array([1.0, -0.5]), jnp.full((8, 1), 0.1)
COST = GoalCost(jnp.zeros(2), 1.0, 10.0, 0.1)


def pendulum(state, control):
    speed = state[1] + 0.1 * (jnp.sin(state[0]) + control[0])
    return jnp.stack([state[0] + 0.1 * speed, speed])


@pytest.fixture(scope="module")
def made():
    system = FunctionSystem(pendulum, 2, 1)
    with pytest.warns(UserWarning, match="an iteration takes about"):
        return Controller(system, COST, GIVEN, schedule=[1.0, 1.0], first_schedule=np.ones(5), deadline=1e-9, upper=2.0)


@pytest.fixture
def controller(made):
    """One of a pendulum, whose later decisions never have time for an iteration."""
    made.reset()
    made.cost = COST
    return made


def test_a_pole_stands_by_a_hundred_decisions_that_compile_nothing(compilations):
    """From 0.2 rad in C MuJoCo, then in gymnasium; a decision is one call of gymnasium's step."""
    env = gymnasium.make("InvertedPendulum-v5").unwrapped
    system = SceneSystem(scene=mg.load_scene(env.model), num_substeps=2)
    cost = GoalCost(jnp.zeros(4), jnp.array([1.0, 10.0, 0.1, 0.1]), 10.0, 0.01)
    balance = Controller(system, cost, jnp.zeros((15, 1)), first_schedule=np.ones(10), deadline=100.0)
    data, num_programs = mujoco.MjData(env.model), len(compilations)
    data.qpos[1] = 0.2
    for _ in range(100):
        data.ctrl[:] = balance(data)
        mujoco.mj_step(env.model, data, 2)
    assert len(compilations) == num_programs
    assert np.abs([data.qpos, data.qvel]).max() < 0.05
    assert str(balance).startswith("100 decisions, ")
    assert ", 0 missed 1e5 ms, 0 cut short. A decision takes about" in str(balance)
    env.reset(seed=0)
    balance.reset()
    assert not any(env.step(balance(env.data))[2] for _ in range(50))


def test_a_first_decision_is_the_plan_of_its_schedule(controller):
    plan = optimise_trajectory(
        controller.system, COST, START, GIVEN, jax.random.key(0), smoother=Exact(), schedule=np.ones(5), upper=2.0
    )
    np.testing.assert_allclose(controller(START), plan.controls[0], atol=1e-12)
    np.testing.assert_allclose(controller.plan.states, plan.states, atol=1e-12)
    assert controller.num_missed == 0


def test_without_time_a_decision_is_a_part_of_an_iteration_and_counts_as_missed(controller, monkeypatch):
    """The first one has no deadline: the course of the given controls, and five iterations of four steps."""
    taken = []
    count = lambda one: lambda *given: taken.append(given) or one(*given)  # noqa: E731
    monkeypatch.setattr(controller, "_programs", {name: count(one) for name, one in controller._programs.items()})
    for num_missed, num_taken in ((0, 21), (1, 22), (2, 23)):
        assert np.isfinite(controller(START)).all()
        assert (controller.num_missed, len(taken)) == (num_missed, num_taken)
    assert ", 2 missed 1e-6 ms, 2 cut short. A decision takes about" in str(controller)


def test_where_nothing_is_better_the_shifted_plan_is_done():
    """A step without derivative: every iteration repeats the controls it begins at."""
    system = FunctionSystem(lambda state, control: state + control + jnp.sqrt(state - state), 1, 1)
    cost = GoalCost(jnp.zeros(1), 1.0, 1.0, 1.0)
    controller = Controller(system, cost, jnp.array([[0.1], [0.2], [0.4]]))
    assert controller(np.zeros(1)) == 0.1
    assert str(controller).endswith("Controls are as given, since no small change lowers the cost: begin with others")
    assert [controller(np.zeros(1)).item() for _ in range(3)] == [0.2, 0.4, 0.4]


def test_a_reset_controller_decides_as_at_first(controller):
    first = controller(START)
    assert controller(START) != first
    controller.reset()
    assert (controller(START), len(controller.seconds)) == (first, 1)


def test_a_moved_goal_is_planned_for_and_compiles_nothing(controller, compilations):
    moved = GoalCost(jnp.asarray(np.array([2.0, 0.0])), 1.0, 10.0, 0.1)
    before, num_programs = controller(START), len(compilations)
    controller.reset()
    controller.cost = moved
    assert controller(START) > before + 0.5
    assert len(compilations) == num_programs


def test_a_cost_of_another_form_needs_a_new_controller(controller):
    with pytest.raises(ValueError, match="make a new Controller for a cost of another form"):
        controller.cost = GoalCost(jnp.zeros(2), jnp.ones(2), 10.0, 0.1)
    assert controller.cost is COST


def test_a_start_of_whole_numbers_is_one_of_floats(controller):
    given, how = (controller.system, COST), {"smoother": Exact(), "schedule": np.ones(5), "upper": 2.0}
    starts = np.array([1, 0]), np.array([1.0, 0.0])
    costs = [optimise_trajectory(*given, start, GIVEN, jax.random.key(0), **how).cost for start in starts]
    assert costs[0] == costs[1]


@pytest.mark.parametrize("gradient", [mg.Discrete, mg.Slope])
def test_a_scene_is_planned_by_c_mujoco_as_by_mjx(gradient):
    """A ball on a spring, two steps: the end, and its linear model up to the rounding of C's differences."""
    ball = "<worldbody><body><joint type='slide' name='x' stiffness='50'/><geom size='.1'/></body></worldbody>"
    scene = mg.load_scene(f"<mujoco>{ball}<actuator><motor joint='x'/></actuator></mujoco>")
    systems = [
        SceneSystem(scene=scene.with_engine(name), num_substeps=2, contact=gradient()) for name in ("mujoco", "mjx")
    ]
    given = (jnp.array([0.1, 1.0]), jnp.array([0.5]), jax.random.key(0))
    models = [jax.jit(lambda s=s: Exact().linear_model(s, *given))() for s in systems]
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5), *models)
