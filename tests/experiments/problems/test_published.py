"""The published tasks: their equations in closed form, and the numbers that were published of them."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from experiments.optimisation import published as settings
from experiments.problems import published
from experiments.problems.published import CENTRES, RADII
from mjxgrad import estimators

NAMES = tuple(settings.TASKS)


@functools.cache
def setting(name):
    return settings.TASKS[name]()


@pytest.mark.parametrize("name", [name for name in NAMES if name != "tennis"])
def test_the_start_costs_what_was_published(name):
    task = setting(name)
    # Published to the nearest unit; the random starts of LQR add 20 times the variance of |x|², a hundredth.
    assert abs(eqx.filter_jit(task.final_cost)(task.params) - task.reference["start"][0]) < 0.55


@pytest.mark.parametrize("name", NAMES)
def test_no_derivative_is_nan(name, key):
    task = setting(name)
    found = eqx.filter_jit(task.objective.differentiate)(task.params, task.objective.sample_noise(key))
    assert found.gradient_by_noise.shape == (np.prod(task.objective.noise_shape),)
    assert np.isfinite(found.gradient_by_noise).all()
    assert np.abs(found.gradient_by_noise).max() > 0


@pytest.mark.parametrize("name", NAMES)
def test_a_step_is_charged_for_nothing_that_comes_later(name, key):
    """As the cost to go of a control takes it; what does come from the noise of a step is charged from it on."""
    task = setting(name)
    objective, later = task.objective, task.objective.task.horizon // 2
    actions, start = objective.split(objective.sample_noise(key))

    @eqx.filter_jit
    def charged(actions):
        return objective.outcome(task.params, actions if start is None else (actions, start)).step_costs

    before, after = charged(actions), charged(actions.at[later:].add(0.1))
    assert before.shape == (objective.task.horizon + 1,)
    np.testing.assert_array_equal(before[:later], after[:later])
    assert (before[later:] != after[later:]).any()


def descend(task, estimator):
    sized = functools.partial(estimator, num_samples=task.num_samples)
    settings = {"optimiser": optax.sgd(task.learning_rate), "num_steps": task.num_steps}
    found = mg.optimise(task.objective, task.params, jax.random.key(0), estimator=sized, **settings).params
    return float(eqx.filter_jit(task.final_cost)(found))


@pytest.mark.slow
def test_friction_separates_the_estimators_as_published():
    """First order does not see that the bodies can stay together, zeroth order does."""
    task = setting("friction")
    zeroth = functools.partial(estimators.zeroth_order, baseline="zero_noise")
    for name, estimator in (("first", estimators.first_order), ("zeroth", zeroth)):
        mean, stddev = task.reference[name]
        assert abs(descend(task, estimator) - mean) < 3 * stddev, name


def test_bodies_apart_move_freely():
    """The velocity is c^t v and the position x + h v Σ cᵗ."""
    task, c, n = published.push(10.0, 0.99, 20), 0.99, 20
    start = jnp.array([0.0, 1.5, -0.3, 0.2])
    states = task.run(jnp.zeros((n, 1)), start=start).states
    last = task.advance(states[-1], jnp.zeros(1))
    travelled = 0.005 * c * (1 - c**n) / (1 - c)
    np.testing.assert_allclose(last, [-0.3 * travelled, 1.5 + 0.2 * travelled, -0.3 * c**n, 0.2 * c**n], rtol=1e-12)


def test_the_spring_pushes_both_bodies_apart_in_proportion_to_its_compression():
    """50 N/m compressed by 0.2 m gives 10 N: h/m F = 0.5 m/s in one step, and the control 0.1 m/s."""
    task = published.push(50.0, 1.0, 1)
    moved = task.advance(jnp.array([0.2, 1.0, 0.0, 0.0]), jnp.array([2.0]))
    np.testing.assert_allclose(moved, [0.2 - 0.005 * 0.4, 1 + 0.005 * 0.5, -0.4, 0.5], rtol=1e-12)


@pytest.mark.parametrize(("speed", "drag"), [(0.05, 0.09), (0.1, 0.18), (0.3, 0.18), (-5.0, -0.18)])
def test_friction_is_viscous_up_to_its_limit(speed, drag):
    moved = published.friction().advance(jnp.array([0.0, 0.05, speed, 0.0]), jnp.zeros(1))
    # h/m = 0.05 m/s per N, on both with opposite signs.
    np.testing.assert_allclose(moved[2:], [speed - 0.05 * drag, 0.05 * drag], rtol=1e-12)


def test_a_point_stops_before_a_disc():
    """Straight at the first one, at 1 m/s: it stops less than one step of 1 cm before, and stays."""
    task, towards = published.motion_planning(), np.array(CENTRES[0]) / np.hypot(*CENTRES[0])
    states = task.run(jnp.broadcast_to(jnp.array(towards), (200, 2))).states
    gaps = np.hypot(*(np.asarray(states) - CENTRES[0]).T) - RADII[0]
    assert 0 <= gaps[-1] < 0.01
    np.testing.assert_array_equal(states[-1], states[100])
    np.testing.assert_allclose(states[20], 0.2 * towards, rtol=1e-12)


def test_a_blocked_point_does_not_feel_its_control():
    """The derivative by the control is zero there, which is why first order sticks."""
    beside = jnp.array([-0.2, 0.299])
    slopes = jax.jacobian(published.motion_planning().advance, argnums=(0, 1))(beside, jnp.array([0.0, 1.0]))
    np.testing.assert_array_equal(slopes[0], np.eye(2))
    np.testing.assert_array_equal(slopes[1], np.zeros((2, 2)))


@pytest.mark.parametrize("angle", [0.0, 0.4, -1.1])
def test_an_elastic_bounce_keeps_the_speed_and_mirrors_the_path(angle):
    """At the surface, 0.2 m from the pad's centre: the path is the mirror image of the one without the pad."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    position, velocity = 0.3 * along + 0.215 * across, 0.7 * along - 0.5 * across
    state = jnp.array([*position, *velocity, 0.0, 0.0, angle])
    moved = published.tennis().advance(state, jnp.zeros(3))
    np.testing.assert_allclose(moved[2:4], 0.7 * along + 0.5 * across, rtol=1e-12)
    # 0.025 m further down it would be at 0.19, mirrored at 0.2 that is 0.21.
    np.testing.assert_allclose(moved[:2], (0.3 + 0.05 * 0.7) * along + 0.21 * across, rtol=1e-12)


def test_a_ball_beyond_the_pad_s_end_flies_on_and_slows_down():
    moved = published.tennis().advance(jnp.array([0.96, 0.21, 0.0, -0.4, 0.0, 0.0, 0.0]), jnp.array([0.2, 0.1, 0.4]))
    np.testing.assert_allclose(moved, [0.96, 0.19, 0.0, -0.4 * 0.999, 0.01, 0.005, 0.02], rtol=1e-12)


@pytest.mark.slow
def test_tennis_starts_at_the_published_cost():
    """Published over 1000 starts, so within their standard error; a ball that is missed costs ten times the others."""
    task = setting("tennis")
    ours = float(eqx.filter_jit(task.final_cost)(task.params))
    starts = jax.vmap(task.objective.task.sample_start)(jax.random.split(jax.random.key(1), 1000))
    actions = jnp.zeros(task.objective.noise_shape)
    costs = jax.jit(jax.vmap(lambda start: task.objective.value(task.params, (actions, start))))(starts)
    error = np.hypot(costs.std() / 1000**0.5, costs.std() / task.num_starts**0.5)
    assert abs(ours - task.reference["start"][0]) < 2 * error


def test_the_regulator_costs_what_its_geometric_series_says():
    """With u = −k x the state is (1 − k)ᵗ x₀, for k = 0 it stays, and the cost is 20 |x₀|²."""
    task, start = published.lqr(3), jnp.array([1.0, -2.0, 0.5])
    for k in (0.0, 0.3):
        shrink = (1 - k) ** 2
        expected = 5.25 * ((1 + 0.1 * k**2) * sum(shrink**t for t in range(10)) + 10 * shrink**10)
        found = task.run(lambda gain, state: -gain * state, k, start=start).cost
        np.testing.assert_allclose(found, expected, rtol=1e-12)
