"""Plans by C MuJoCo: the motion is its own, and an iteration asks it a few times."""

import collections
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.engines.pool import Pool
from mjxgrad.planning import Analytic, Controller, Exact, GoalCost, SceneSystem
from mjxgrad.planning.trajectory import Course, Feedback, Problem

# A box with an arm, which slides on the floor and turns.
BOX = """<mujoco><option timestep=".01" cone="elliptic"/><worldbody><geom type="plane" size="2 2 .1"/>
  <body pos="0 0 .1"><freejoint name="box"/><geom type="box" size=".1 .15 .1"/><body pos="0 0 .1">
  <joint name="arm" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".03"/></body></body></worldbody>
  <actuator><motor joint="box" gear="40 10 0 0 0 20"/><motor joint="arm" ctrlrange="-1 1"/></actuator></mujoco>"""
HORIZON = 6


@pytest.fixture(params=["double", "single"])
def error(request):
    """The tolerance: what the solves leave, from another warm start, or roundings of single precision."""
    with jax.enable_x64(request.param == "double"):
        yield 1e-6 if request.param == "double" else 2e-4


@pytest.fixture
def system(error):
    return SceneSystem(scene=mg.load_scene(BOX, engine="mujoco"), num_substeps=2)


def by_steps(monkeypatch):
    """From here on plans call C MuJoCo in each step."""
    monkeypatch.setattr(Analytic, "steered", lambda smoother, system: None)


def start_of(system):
    """Turned, and in motion."""
    change = np.random.default_rng(3).normal(size=system.num_changes)
    change[2:5] = 0.0  # flat on the floor
    return jax.jit(system.retract)(system.origin, jnp.asarray(0.2 * change, system.origin.dtype))


def controller_of(system):
    goal = jax.jit(system.retract)(system.origin, 0.3 * jnp.ones(system.num_changes).at[2:5].set(0.0))
    cost, given = GoalCost(goal, 1.0, 10.0, 0.01), jnp.zeros((HORIZON, 2))
    return Controller(system, cost, given, schedule=[1.0, 1.0], first_schedule=[1.0, 1.0], num_samples=0)


def test_a_plan_is_to_the_bit_the_rollout_of_its_controls(system):
    scene, nq, start, controller = system.scene, system.scene.model.nq, start_of(system), controller_of(system)
    for _ in range(2):
        controller(np.asarray(start))
    begin = mg.initial_state(scene, start[:nq], start[nq:])
    found = mg.rollout(scene.with_engine("mujoco"), begin, jnp.repeat(controller.plan.controls, 2, axis=0))
    np.testing.assert_array_equal(controller.plan.states[:, :nq], found.qpos[::2])
    np.testing.assert_array_equal(controller.plan.states[:, nq:], found.qvel[::2])
    assert np.abs(controller.plan.controls).min() > 1e-3


@pytest.mark.parametrize("error", ["double"], indirect=True)
def test_an_iteration_asks_c_mujoco_a_few_times(monkeypatch, system):
    """Twice for all linear models, twice for all step lengths, once for the motion of the plan with which a decision begins."""
    counts = collections.Counter()
    for name in ("steer", "product", "follow"):
        monkeypatch.setattr(Pool, name, _counted(counts, name))
    controller, state = controller_of(system), np.asarray(start_of(system))
    controller(state)
    counts.clear()
    controller(state)
    assert counts == {"steer": 3, "product": 2}


def _counted(counts, name):
    function = getattr(Pool, name)

    def call(*given, **settings):
        counts[name] += 1
        return function(*given, **settings)

    return call


@pytest.mark.parametrize("error", ["double", pytest.param("single", marks=pytest.mark.slow)], indirect=True)
def test_a_plan_is_that_of_single_steps(error, system, monkeypatch):
    start, ours = np.asarray(start_of(system)), controller_of(system)
    by_steps(monkeypatch)
    other = controller_of(system)
    assert np.abs(ours(start) - other(start)).max() < 100 * error
    np.testing.assert_allclose(ours.plan.states, other.plan.states, atol=10 * error)
    np.testing.assert_allclose(ours.plan.controls, other.plan.controls, atol=100 * error)
    np.testing.assert_allclose(ours.plan.cost, other.plan.cost, rtol=error)
    assert np.abs(ours.plan.controls).min() > 1e-3


def test_a_law_turns_a_free_body_as_single_steps_do(error, system, monkeypatch):
    """Around states that it is not at; a step of zero repeats the controls, even under gains that are NaN."""
    rng = np.random.default_rng(0)
    start, dtype = start_of(system), system.origin.dtype
    changes, gain = (rng.normal(size=(HORIZON, *sizes, system.num_changes)) for sizes in ((), (2,)))
    nominal = jax.jit(jax.vmap(system.retract, (None, 0)))(start, jnp.asarray(0.1 * changes, dtype).at[0].set(0.0))
    controls, change = jnp.asarray(rng.normal(size=(2, HORIZON, 2)), dtype)
    limits = jnp.array([1.5, 1.0], dtype)
    course = Course(jnp.concatenate([nominal, nominal[-1:]]), controls, jnp.zeros((), dtype))
    keys = jax.random.split(jax.random.key(0), HORIZON)

    def run(step, factor):
        problem = Problem(system, GoalCost(start, 1.0, 1.0, 1.0), Exact(), keys, -limits, limits)
        law = Feedback(change, factor * jnp.asarray(gain, dtype), jnp.zeros((), dtype), jnp.asarray(True))
        return problem.run(Exact(), course, law, step)

    given = (jnp.array([0.5, 0.0], dtype), jnp.array([1.0, jnp.nan], dtype))
    found = jax.jit(jax.vmap(run))(*given)
    by_steps(monkeypatch)
    expected = jax.jit(jax.vmap(run))(*given)
    np.testing.assert_allclose(found.states, expected.states, atol=10 * error)
    np.testing.assert_allclose(found.controls, expected.controls, atol=10 * error)
    np.testing.assert_array_equal(found.controls[1], np.clip(controls, -limits, limits))
    assert np.abs(found.controls[0] - found.controls[1]).max() > 0.1
    assert (np.abs(found.controls[0]) == limits).any()


@pytest.mark.parametrize("gradient", [mg.Discrete, mg.Slope])
def test_linear_models_are_those_of_single_steps(error, system, monkeypatch, gradient):
    system = dataclasses.replace(system, contact=gradient())
    given = (start_of(system), jnp.array([0.3, -0.2]), None)
    found = jax.jit(functools.partial(Exact().linear_model, system))(*given)
    by_steps(monkeypatch)
    expected = jax.jit(functools.partial(Exact().linear_model, system))(*given)
    for name in ("A", "B"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=error * np.abs(expected.A).max())
