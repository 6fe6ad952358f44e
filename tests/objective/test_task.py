"""Where rollouts begin, and what they are charged by step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.objective import closed_loop, open_loop
from mjxgrad.rollouts import initial_state
from mjxgrad.scene import load_scene
from mjxgrad.tasks import SceneTask
from tests.estimators import textbook
from tests.estimators.textbook import POLICY_PARAMS
from tests.objective.test_objective import STDDEV


@pytest.fixture
def objective():
    return closed_loop(textbook.RandomStart(), textbook.linear_policy, STDDEV, params=POLICY_PARAMS)


@pytest.fixture
def params(objective):
    return objective.ravel(POLICY_PARAMS)


def test_mirrored_and_redrawn_noise_begins_at_the_same_place(objective, key):
    """Redrawn, it is what `sample_noise` would draw otherwise: new actions, old start."""
    noise, start = objective.sample_noise(key)
    mirrored, same = objective.mirror((noise, start))
    other, as_well = objective.redraw((noise, start), jax.random.key(1))
    np.testing.assert_array_equal(mirrored, -noise)
    np.testing.assert_array_equal([same, as_well], [start, start])
    assert np.abs(other - noise).min() > 0


def test_a_task_is_shown_in_a_few_lines():
    """A scene within anything is its name, not its model of hundreds of fields."""
    scene = load_scene("<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body></worldbody></mujoco>")
    lines = repr(SceneTask(scene, initial_state(scene), lambda course: course.qpos[-1, 0], 7)).splitlines()
    assert len(lines) < 10
    assert lines[1].strip() == "scene=Scene(name='the MJCF'),"
    assert lines[-2].strip() == "horizon=7"


def test_zero_noise_takes_the_nominal_start(objective, params):
    fixed = eqx.tree_at(lambda o: o.task, objective, textbook.LinearSystem())
    assert objective.value(params, objective.zero_noise()) == fixed.value(params, fixed.zero_noise())


def test_a_random_start_is_where_the_rollout_begins(objective, params, key):
    noise = objective.sample_noise(key)
    np.testing.assert_array_equal(objective.outcome(params, noise).states[0], noise[1])
    assert not np.allclose(noise[1], objective.task.start)


def test_a_nominal_start_built_unlike_the_random_ones_is_refused():
    class Forgetful(textbook.RandomStart):
        def nominal_start(self):
            return None

    with pytest.raises(ValueError, match="nominal_start must have the structure of sample_start"):
        open_loop(Forgetful(), STDDEV).zero_noise()


CART = """
<mujoco>
  <option timestep="0.05"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body></worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""
THRUSTS = jnp.array([[1.0], [-2.0], [4.0]])


def per_state(trajectory):
    """Of every state, and of the control that follows it."""
    return (trajectory.qpos[:, 0] - 0.1) ** 2 + jnp.append(trajectory.ctrl[:, 0] ** 2, 0.0)


@pytest.fixture(scope="module")
def cart():
    scene = load_scene(CART)

    def start(key):
        return initial_state(scene, qpos=0.3 + 0.2 * jax.random.normal(key, (1,)))

    return SceneTask(scene, initial_state(scene), per_state, horizon=3, start_distribution=start)


def test_a_scene_charges_by_step_from_where_it_starts(cart, key):
    """Semi-implicit Euler of a mass of 2 kg: v += h u/m, x += h v."""
    objective = open_loop(cart, STDDEV)
    noise, start = objective.sample_noise(key)
    outcome = eqx.filter_jit(objective.outcome)(THRUSTS.ravel(), (noise, start))
    x, v, expected = float(start.qpos[0]), 0.0, []
    for u in np.asarray(THRUSTS + noise)[:, 0]:
        expected.append((x - 0.1) ** 2 + u**2)
        v += 0.05 * u / 2
        x += 0.05 * v
    expected.append((x - 0.1) ** 2)
    np.testing.assert_allclose(outcome.step_costs, expected, rtol=1e-9)
    np.testing.assert_allclose(outcome.cost, np.sum(expected), rtol=1e-9)
    assert objective.zero_noise()[1].qpos == 0


def look(model, data):
    """Where the cart is, and how it is pushed: the control before, while a policy looks."""
    return jnp.stack([data.qpos[0], data.qacc[0]])


@pytest.fixture(scope="module")
def seeing(cart):
    """Its cost is of what is observed: the place, and the acceleration under the control of the step."""
    return SceneTask(
        cart.scene, cart.state, lambda t: t.observations.sum(axis=1), 3, observe=look, policy_sees="observations"
    )


def test_a_policy_that_sees_observations_looks_before_it_chooses_and_the_cost_reads_them(seeing):
    """The recursion u_t = k·(x_t + u_{t−1}/m) + ½, semi-implicit Euler of 2 kg."""
    outcome = eqx.filter_jit(seeing.run)(lambda gain, seen: gain * seen.sum(keepdims=True) + 0.5, -0.7)
    x, v, u, states, costs = 0.0, 0.0, 0.0, [], []
    for _ in range(3):
        states.append((x, u / 2))
        u = -0.7 * (x + u / 2) + 0.5
        costs.append(x + u / 2)
        v += 0.05 * u / 2
        x += 0.05 * v
    np.testing.assert_allclose(outcome.states, states, rtol=1e-9)
    np.testing.assert_allclose(outcome.step_costs, [*costs, x + u / 2], rtol=1e-9)


def test_a_policy_that_sees_observations_is_differentiated_by_its_noise(seeing, key):
    objective = closed_loop(seeing, lambda gain, seen: gain @ seen, STDDEV, params=jnp.ones((1, 2)))
    params, noise = jnp.array([0.3, -0.4]), objective.sample_noise(key)
    found = eqx.filter_jit(objective.differentiate)(params, noise)
    gradient = jax.jit(jax.grad(objective.value))(params, noise)
    assert np.abs(gradient).min() > 1e-6
    np.testing.assert_allclose(found.pull_back(found.gradient_by_noise), gradient, rtol=1e-8)


def test_observations_without_a_function_that_observes_are_refused(cart):
    blind = SceneTask(cart.scene, cart.state, per_state, 3, policy_sees="observations")
    with pytest.raises(ValueError, match='policy_sees must be "state", or "observations" with observe='):
        blind.run(THRUSTS)
