"""A finger pushes a box by receding horizon, judged in C MuJoCo: from several starts, in time, and where it touches nothing."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.planning import Analytic, Controller, Exact, GoalCost, LeastSquares, SceneSystem, optimise_trajectory
from mjxgrad.planning.trajectory import deviations, posed, random_changes

PUSHER = """<mujoco><option timestep=".005"/><worldbody><geom name="floor" type="plane" size="2 2 .1"/>
  <body pos="-.15 0 .09"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
    <geom size=".04" mass=".5"/><site name="tip"/></body>
  <body pos="0 0 .05"><freejoint name="box"/><geom type="box" size=".05 .05 .05" mass=".3"/></body></worldbody><actuator>
  <position joint="x" kp="100" kv="10" ctrlrange="-1 1"/><position joint="y" kp="100" kv="10" ctrlrange="-1 1"/>
  </actuator></mujoco>"""
GOAL, SUBSTEPS, KEY = np.array([0.15, 0.03]), 6, jax.random.key(0)
NOTHING = (
    "no control moves 'box', which has a cost.* where the cost has the distance.* nothing needs to be done; else add it"
)


class Push(LeastSquares):
    """The box is to be at its goal; with a weight, the finger behind it."""

    distance: jax.Array

    def terminal_residuals(self, system, state):
        box, tip = state[2:4], system.placed(state).site_xpos[0, :2]
        away = GOAL - box
        behind = box - 0.09 * away / jnp.sqrt(away @ away + 1e-3)
        return jnp.concatenate([5 * away, self.distance * (tip - behind), 0.2 * state[11:13]])

    def residuals(self, system, state, control):
        return jnp.concatenate([0.5 * self.terminal_residuals(system, state), 0.05 * state[9:11]])


@pytest.fixture(scope="module")
def system():
    return SceneSystem(scene=mg.load_scene(PUSHER, engine="mujoco"), num_substeps=SUBSTEPS)


@pytest.fixture(scope="module")
def made(system):
    return Controller(system, Push(jnp.asarray(1.0)), jnp.zeros((10, 2)), first_schedule=[1.0], num_samples=0)


@pytest.fixture
def controller(made):
    made.reset()
    made.cost, made.deadline = Push(jnp.asarray(1.0)), None
    return made


@pytest.mark.filterwarnings("ignore:no control moves")
def test_boxes_are_pushed_to_their_goal_and_stay(system):
    """From 11 to 15 cm away. A push beside the middle turns a box, and rounding decides how far: so the median is judged.

    The median was 4 to 7 mm in four runs and the worst 16 mm; without random changes of plans 7 to 16 mm and 9 cm; 2 to 4 cm
    where linear models were taken along plans that are no motion.
    """
    controller = Controller(system, Push(jnp.asarray(1.0)), jnp.zeros((10, 2)))
    model, found = mujoco.MjModel.from_xml_string(PUSHER), []
    for place in [(0.0, 0.0), (0.03, -0.03), (-0.01, 0.02), (0.015, -0.015), (0.04, 0.02)]:
        controller.reset()
        data = mujoco.MjData(model)
        data.qpos[2:4] = place
        for k in range(60):
            data.ctrl[:] = controller(data)
            mujoco.mj_step(model, data, SUBSTEPS)
            if k >= 40:
                found.append(np.linalg.norm(data.qpos[2:4] - GOAL))
    assert np.median(found) < 0.015


def test_where_nothing_is_touched_a_warning_says_what_to_do(controller, system):
    controller.cost = Push(jnp.asarray(0.0))
    with pytest.warns(UserWarning, match=NOTHING):
        controller(np.asarray(system.origin))
    assert "Controls are as given, since no control moves 'box'" in str(controller)
    assert "; add the distance between what pushes and what is pushed to the cost, smooth by Analytic" in str(
        controller
    )


def test_coordinates_have_plain_names_and_the_unnamed_those_of_their_bodies(system):
    assert system.names == ("x", "y", *6 * ["box"], "speed of x", "speed of y", *6 * ["speed of box"])
    unnamed = mg.load_scene("<mujoco><worldbody><body name='cup'><joint/><geom size='.1'/></body></worldbody></mujoco>")
    assert SceneSystem(unnamed).names == ("joint of cup", "speed of joint of cup")


@pytest.mark.filterwarnings("ignore:no control moves")
def test_a_deadline_is_kept_where_an_iteration_takes_longer(controller, system, monkeypatch):
    """Steps of 100 ms and a deadline of 280: two of four are done in a decision, the rest in the next, and the plan improves."""
    now = [0.0]

    def slow(program):
        def run(*given):
            now[0] += 0.1
            return program(*given)

        return run

    model, costs = mujoco.MjModel.from_xml_string(PUSHER), []
    data = mujoco.MjData(model)
    monkeypatch.setattr("mjxgrad.planning.controller.time", SimpleNamespace(perf_counter=lambda: now[0]))
    iteration = controller._iteration
    monkeypatch.setattr(iteration, "programs", {name: slow(one) for name, one in iteration.programs.items()})
    controller(data)
    controller.deadline = 0.28
    for _ in range(12):
        data.ctrl[:] = controller(data)
        mujoco.mj_step(model, data, SUBSTEPS)
        costs.append(controller.plan.cost)
    assert controller.num_missed == 0
    assert controller.num_cut >= 4
    assert "13 decisions" in str(controller)
    finite = np.array(costs)[np.isfinite(costs)]
    assert 3 < len(finite) < 10
    assert finite[-1] < 0.5 * finite[0]


def test_what_a_decision_takes_is_said_before_the_first(controller):
    assert str(controller).startswith("A decision takes about ")
    assert all(f"{part} " in str(controller) for part in ("linear models", "backward pass", "rollouts"))
    controller.price = {"linear models": 0.02, "backward pass": 0.003, "rollouts": 0.0052}
    assert "28.2 ms (35.5 Hz): linear models 20, backward pass 3, rollouts 5; compiled in" in str(controller)


def test_too_short_a_deadline_is_told(system):
    with pytest.warns(
        UserWarning, match="and decisions may miss the deadline of 0.0001 ms: take one of .*; no plan is short enough"
    ):
        Controller(system, GoalCost(system.origin, 1.0, 1.0, 1.0), jnp.zeros((2, 2)), deadline=1e-7)


def test_random_changes_of_a_plan_touch_what_derivatives_do_not_see(system):
    """The gap is 6 cm; a twentieth of the controls' range of 2 m reaches it in a few iterations."""
    given, how = (
        (Push(jnp.asarray(0.0)), system.origin, jnp.zeros((12, 2)), KEY),
        {"smoother": Exact(), "schedule": jnp.ones(5)},
    )
    still = optimise_trajectory(system, *given, **how)
    assert still.cost == still.start_cost
    assert "num_samples=32" in still.verdict()
    found = optimise_trajectory(system, *given, **how, num_samples=16)
    assert found.states[-1, 2] > 0.05
    assert found.cost < 0.5 * found.start_cost


def test_random_changes_are_as_large_as_their_limits_say(system):
    """A twentieth of the range, or what is given: half of the samples of a normal number are within 0.6745 of it."""
    problem = posed(
        system, Push(jnp.asarray(0.0)), None, jnp.zeros((12, 2)), KEY, Exact(), [[1.0]], None, jnp.array([1.0, 3])
    )[0]
    np.testing.assert_allclose(deviations(None, problem), [0.1, 0.2], rtol=1e-6)
    np.testing.assert_allclose(deviations(0.3, problem), [0.3, 0.3])
    changes = np.asarray(random_changes(KEY, jnp.array([1.0, 2.0]), 500, 8))
    assert changes.shape == (500, 8, 2)
    np.testing.assert_array_equal(changes[:, 0], changes[:, 1])
    sizes = np.geomspace(0.125, 1, 500)[:, None, None] * [1.0, 2.0]
    assert np.mean(np.abs(changes) < 0.6745 * sizes) == pytest.approx(0.5, abs=0.03)  # 4000 numbers: 4 standard errors


@pytest.fixture
def sampling(system):
    return Controller(system, Push(jnp.asarray(0.0)), jnp.zeros((12, 2)), num_samples=16, stddev=0.3)


@pytest.mark.filterwarnings("ignore:no control moves")
def test_samples_touch_what_derivatives_do_not_see(sampling, system):
    for _ in range(3):
        sampling(np.asarray(system.origin))
    assert sampling.plan.states[-1, 2] > 0.01


@pytest.mark.filterwarnings("ignore:no control moves")
def test_random_plans_are_tried_while_an_iteration_is_under_way(sampling, system):
    """One part a decision: linear models, random plans, the backward pass, rollouts. Rollouts alone give a plan a cost."""
    sampling(np.asarray(system.origin))
    sampling.deadline, has_cost = 1e-9, []
    for _ in range(4):
        sampling(np.asarray(system.origin))
        has_cost.append(bool(np.isfinite(sampling.plan.cost)))
    assert has_cost == [False, True, False, True]


def test_widened_contacts_of_c_mujoco_act_from_a_distance(system):
    """The gap is 6 cm: four lengths reach it or do not. What stands on the floor stays there."""
    state, control = system.origin, jnp.array([0.05, 0.0])
    far = Analytic(mg.Smoothing(0.03)).linear_model(system, state, control, KEY)
    near = Analytic(mg.Smoothing(0.011)).linear_model(system, state, control, KEY)
    none = Exact().linear_model(system, state, control, KEY)
    assert far.B[8 + 2, 0] > 1e-3
    np.testing.assert_allclose(near.B, none.B, atol=1e-6)
    end = Analytic(mg.Smoothing(0.011)).step(system, state, control, KEY)
    np.testing.assert_allclose(end, system.step(state, control), atol=1e-6)
    backward = Analytic(mg.Smoothing(0.03, mode="backward"))
    np.testing.assert_allclose(backward.step(system, state, control, KEY), system.step(state, control), atol=1e-9)
    np.testing.assert_allclose(backward.linear_model(system, state, control, KEY).B, far.B, atol=1e-6)
