"""Control by receding horizon: a pole that must stand, the clock, and where each decision begins."""

import dataclasses
import warnings
from collections.abc import Callable
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.planning import Controller, Cost, Exact, FunctionSystem, GoalCost, SceneSystem, optimise_trajectory
from mjxgrad.planning.iteration import Iteration

START, GIVEN = np.array([1.0, -0.5]), jnp.full((8, 1), 0.1)
COST = GoalCost(jnp.zeros(2), 1.0, 10.0, 0.1)


def pendulum(state, control):
    speed = state[1] + 0.1 * (jnp.sin(state[0]) + control[0])
    return jnp.stack([state[0] + 0.1 * speed, speed])


@pytest.fixture(scope="module")
def made():
    system = FunctionSystem(pendulum, 2, 1)
    with pytest.warns(UserWarning, match="an iteration takes about"):
        return Controller(
            system, COST, GIVEN, schedule=[1.0, 1.0], first_schedule=np.ones(5), num_samples=0, deadline=1e-9, upper=2.0
        )


@pytest.fixture
def controller(made):
    """One of a pendulum, whose later decisions never have time for a part of an iteration."""
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
    assert ", 0 missed 1e5 ms, 0 cut short. An iteration took " in str(balance)
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
    """The first one has no deadline: the course of the given controls, and five iterations."""
    taken, iteration = [], controller._iteration
    count = lambda one: lambda *given: taken.append(given) or one(*given)  # noqa: E731
    monkeypatch.setattr(iteration, "programs", {name: count(one) for name, one in iteration.programs.items()})
    first = 1 + 5 * (iteration.num_pieces + 2)
    for num_missed in range(3):
        assert np.isfinite(controller(START)).all()
        assert (controller.num_missed, len(taken)) == (num_missed, first + num_missed)
    assert ", 2 missed 1e-6 ms, 2 cut short. An iteration took " in str(controller)


def test_a_decision_is_free_of_what_the_last_one_failed_at(controller, monkeypatch):
    """The goal moves when no step had lowered the cost for long: regularisation held a loader still for good."""
    monkeypatch.setattr(controller, "deadline", None)

    def lowered(regularisation):
        controller.reset()
        controller.cost = COST
        controller(START)
        held = jnp.asarray(regularisation, controller._search.regularisation.dtype)
        controller._search = dataclasses.replace(controller._search, regularisation=held)
        controller.cost = GoalCost(jnp.array([2.0, 0.0]), 1.0, 10.0, 0.1)
        controller(START)
        return float(controller.plan.cost)

    assert lowered(1e6) < 1.1 * lowered(1e-6)


def test_what_decisions_took_is_one_rate(controller):
    """Beside what an iteration takes: a foretold rate next to a measured one contradicted it."""
    assert str(controller).count(" Hz") == 1
    controller(START)
    assert str(controller).count(" Hz") == 1


class Clock:
    """A clock that only programs move: linear models by 10 ms and by 10 more for each step, the others as given (s)."""

    def __init__(self, monkeypatch, **each):
        self.now, self.each = 0.0, {"backward pass": 0.01, "rollouts": 0.02} | each
        timer, run = SimpleNamespace(perf_counter=lambda: self.now), Iteration.run
        monkeypatch.setattr("mjxgrad.planning.controller.time", timer)
        monkeypatch.setattr("mjxgrad.planning.iteration.time", timer)

        def slow(iteration, turn, *given, **how):
            self.now += self.each.get(turn[0], 0.01 + 0.01 * iteration.count)
            return run(iteration, turn, *given, **how)

        monkeypatch.setattr(Iteration, "run", slow)

    def controller(self, horizon, deadline):
        """Return a controller and what its warning says."""
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            made = Controller(FunctionSystem(pendulum, 2, 1), COST, jnp.full((horizon, 1), 0.1), deadline=deadline)
        return made, "".join(str(one.message) for one in told)


def test_advice_that_is_followed_is_the_last(monkeypatch):
    """Of 12 steps, two at a time: 6 x 30 + 10 + 20 = 210 ms; a step alone takes 20 + 10 + 20 = 50 ms.

    The deadline of 120 ms leaves a third of it for other programs: 80 ms, 50 + 160 (n - 1) / 11, so 3 steps.
    """
    clock = Clock(monkeypatch)
    _, told = clock.controller(12, 0.12)
    assert "an iteration takes about 210 ms, and is spread over some 3 decisions to keep the deadline of 120 ms" in told
    assert told.endswith("for one in each take a deadline of 315 ms, or a plan of 3 steps")
    assert [clock.controller(*followed)[1] for followed in ((3, 0.12), (12, 0.315))] == ["", ""]


def test_a_deadline_that_no_plan_fits_is_told_with_the_least_one(monkeypatch):
    clock = Clock(monkeypatch, rollouts=0.1)
    _, told = clock.controller(8, 0.1)
    assert "its rollouts alone 100 ms, and decisions may miss the deadline of 100 ms: take one of 150 ms, or" in told
    assert told.endswith("; no plan is short enough, one of 1 step takes 130 ms")


def test_one_step_is_no_steps(monkeypatch):
    """Three of them take 3 x 20 + 10 + 20 = 90 ms, and one 50; two thirds of the deadline are 53."""
    assert Clock(monkeypatch).controller(3, 0.08)[1].endswith("a deadline of 135 ms, or a plan of 1 step")


def test_a_short_deadline_is_kept_since_linear_models_are_taken_of_few_steps_at_a_time(monkeypatch):
    """Half of 16 steps would take 90 ms. Two take 30, and an iteration ten decisions of 50 ms at most."""
    controller, _ = Clock(monkeypatch).controller(16, 0.05)
    for _ in range(40):
        controller(START)
    assert controller.num_missed == 0
    assert max(controller.seconds[1:]) <= 0.05
    assert len(controller._taken["rollouts"]) >= 4


def test_linear_models_that_take_as_long_of_few_steps_stay_whole(monkeypatch):
    """As on a GPU: more turns would only take longer."""
    controller, _ = Clock(monkeypatch, **{"linear models": 0.03}).controller(8, 0.05)
    assert controller._iteration.count == 8


def test_every_step_s_linear_model_is_taken_though_the_plan_moves_on_meanwhile():
    """Of nine steps two at a time, one decision each. Numbers are those of the first plan, from which none is left out."""
    iteration = Controller(FunctionSystem(pendulum, 2, 1), COST, jnp.zeros((9, 1)))._iteration.by(2)
    turn, taken, shift = iteration.first, [], 0
    while turn[0] == "linear models":
        taken += [turn[1] + shift, turn[1] + shift + 1]
        shift += 1
        turn = iteration.moved_on(iteration.after(turn))
    assert set(range(shift, 9)) <= set(taken)
    assert shift == 4  # 9 steps, three fewer in each decision: two are taken, and one is done


def test_a_scene_is_measured_at_its_first_key_frame():
    """The reference pose of a robot may be deep in the floor, where a step takes several times as long."""
    xml = "<worldbody><body><joint type='slide' name='x'/><geom size='.1'/></body></worldbody>"
    scene = mg.load_scene(
        f"<mujoco>{xml}<actuator><motor joint='x'/></actuator><keyframe><key qpos='3' qvel='4'/></keyframe></mujoco>",
        engine="mujoco",
    )
    found = Controller(SceneSystem(scene), GoalCost(jnp.zeros(2), 1.0, 1.0, 1.0), jnp.zeros((2, 1)))
    np.testing.assert_array_equal(found._iteration._start, [3, 4])


def test_where_nothing_is_better_the_shifted_plan_is_done():
    """A step without derivative: every iteration repeats the controls it begins at."""
    system = FunctionSystem(lambda state, control: state + control + jnp.sqrt(state - state), 1, 1)
    cost = GoalCost(jnp.zeros(1), 1.0, 1.0, 1.0)
    controller = Controller(system, cost, jnp.array([[0.1], [0.2], [0.4]]), num_samples=0)
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


class Measured(Cost):
    """A function of the last state, one of whose numbers counts."""

    function: Callable
    index: int | np.ndarray

    def stage(self, system, state, control):
        return control @ control

    def terminal(self, system, state):
        return self.function(state)[self.index]


def measured(goal, index):
    return Measured(lambda state: (state - goal) ** 2, index)


@pytest.mark.parametrize("index", [int, np.array])
def test_a_cost_of_another_function_or_index_needs_a_new_controller(index):
    """They are compiled: the old ones would go on. A function that is defined anew with equal content is the same."""
    given = measured(1.0, index(0))
    controller = Controller(FunctionSystem(pendulum, 2, 1), given, GIVEN)
    for other in (measured(-1.0, index(0)), measured(1.0, index(1))):
        with pytest.raises(ValueError, match="differ in the values of its floats alone: make a new Controller"):
            controller.cost = other
    assert controller.cost is given
    controller.cost = (same := measured(1.0, index(0)))
    assert controller.cost is same


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


def test_a_cost_that_is_no_number_is_said():
    """The pendulum moves on; the cost alone is NaN, as of a root below zero."""

    class Root(Cost):
        def stage(self, system, state, control):
            return jnp.sqrt(-1 - state @ state) + control @ control

        def terminal(self, system, state):
            return state @ state

    cost = Root()
    made = Controller(FunctionSystem(pendulum, 2, 1), cost, GIVEN)
    with pytest.warns(UserWarning, match="no finite number, though all their states are"):
        made(START)
    assert str(made).endswith("no finite number, though all their states are")
    how = {"smoother": Exact(), "schedule": jnp.ones(2)}
    plan = optimise_trajectory(FunctionSystem(pendulum, 2, 1), cost, START, GIVEN, jax.random.key(0), **how)
    assert "no finite number, though all their states are" in str(plan)


def test_what_plans_cost_is_printed(made):
    made.reset()
    made.seconds, made.costs = [0.1, 0.1, 0.1], [3.0, np.inf, 5.0]
    assert "Plans cost 4 in the median, the last 5" in str(made)
