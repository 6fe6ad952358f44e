"""The stroke against hard balls, whose motion is known; the pin and its bed against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.problems.untouched import DENT, DEPTH, billiards, hard_cost, hard_optimum, rolling_pin

HORIZON = 40


@pytest.fixture(scope="module")
def stroke():
    return billiards(num_pieces=10).with_engine("mujoco")  # which compiles in no time


@pytest.fixture(scope="module")
def differentiated(stroke):
    return jax.jit(jax.value_and_grad(stroke.cost))


@pytest.fixture(scope="module")
def pin():
    return rolling_pin(horizon=HORIZON)


@pytest.fixture(scope="module")
def seen(pin):
    """Give cost, gradient and last position for a price of the distance, a larger radius and a margin: one program."""

    def run(params, *remedies):
        changed = pin.seen_from_afar(*remedies)
        return *jax.value_and_grad(changed.cost)(params), changed.trajectory(params).qpos[-1]

    every = eqx.filter_jit(jax.vmap(run, (None, 0, 0, 0)))
    return lambda params, *variants: every(params, *jnp.asarray(variants, float).T)


def best_forces(num_pieces):
    """The best force is linear in time up to the collision; here its mean over each piece."""
    _, end, speed = hard_optimum()
    gap = np.sqrt(2) - 0.4
    edges = np.minimum(np.arange(num_pieces + 1) / num_pieces, end)
    first, slope = 6 * gap / end**2 - 2 * speed / end, 6 * speed / end**2 - 12 * gap / end**3
    along = np.diff(first * edges + slope * edges**2 / 2) * num_pieces
    return np.repeat(along[:, None], 2, axis=1) / np.sqrt(2)


def test_the_optimum_for_hard_balls_is_the_published_one():
    assert hard_optimum()[0] == pytest.approx(1.396542, abs=1e-6)


def test_the_best_force_played_on_hard_balls_costs_the_optimum():
    # In pieces of 1 ms the force is right but for the piece in which the balls meet: 1e-3 of the time.
    assert hard_cost(best_forces(1000)) == pytest.approx(hard_optimum()[0], abs=2e-3)


def test_the_simulated_stroke_costs_what_hard_balls_say(differentiated):
    for forces in (best_forces(10), np.tile([3.2, 2.9], (10, 1))):
        simulated, _ = differentiated(jnp.asarray(forces.ravel()))
        # The contact takes 11 ms of a second and begins 27 mm early.
        assert float(simulated) == pytest.approx(hard_cost(forces), abs=0.03)


def test_as_long_as_the_balls_do_not_touch_the_derivative_is_that_of_the_effort(stroke, differentiated):
    start = stroke.start(1.3)
    cost, gradient = differentiated(start)
    assert float(cost) == pytest.approx(2 + 0.1 * 2 * 1.3**2, rel=1e-12)
    assert np.allclose(gradient, 2 * 0.1 * start / 10, rtol=1e-6)


def test_a_contact_that_begins_earlier_lets_the_derivative_see_the_other_ball(stroke):
    start = stroke.start(1.3)
    gradient = jax.jit(jax.grad(stroke.seen_from_afar(0, 0, 0.3).cost))(start)
    effort = 2 * 0.1 * start / 10
    # Pushing harder at first brings the other ball closer to the target, which is worth more than the effort.
    assert np.all(np.asarray(gradient - effort)[:4] < -0.01)


@pytest.mark.slow
def test_the_gradient_is_exactly_zero_where_nothing_touches_and_not_with_a_remedy(seen):
    untouched = jnp.zeros(2 * HORIZON)
    costs, gradients, _ = seen(untouched, (0, 0, 0), (0.3, 0, 0), (0, 0.04, 0), (0, 0, 0.04))
    assert not gradients[0].any()
    # The bed is flat, so the cost is 1; the distance stays at its start, so proximity adds its price.
    np.testing.assert_allclose(costs[:2], [1, 1.3], rtol=1e-12)
    largest_by_height = np.abs(gradients[1:, 1::2]).max(axis=1)
    assert (largest_by_height > 1e-4).all()


def test_the_cost_is_the_closed_form_of_the_bed_and_the_controls(pin):
    # Too little for the pin to reach the bed, that has been dented by hand.
    params, heights = jnp.full(2 * HORIZON, 2e-3), np.arange(8) * 1e-3
    dented = eqx.tree_at(lambda task: task.target, pin, pin.target - heights)
    wanted = np.where(np.isin(np.arange(8), DENT), -DEPTH, 0.0)
    expected = np.sum((heights - wanted) ** 2) / (4 * DEPTH**2) + 1e-3 * 4e-6
    np.testing.assert_allclose(dented.with_engine("mujoco").cost(params), expected, rtol=1e-12)


def test_the_distance_is_that_to_the_nearest_of_the_others(pin, stroke):
    # The pin, radius 40 mm, is 30 mm above the third cap, radius 15 mm; moved 60 mm on it is above the fifth, here sunk.
    at_rest = np.zeros(10)
    np.testing.assert_allclose(pin.distance(jnp.asarray(at_rest)), 0.03, rtol=1e-12)
    moved = at_rest.copy()
    moved[[0, 2 + 4]] = 0.06, -0.05
    # Nearest is then its neighbour, 30 mm aside and 85 mm below.
    np.testing.assert_allclose(pin.distance(jnp.asarray(moved)), np.hypot(0.03, 0.085) - 0.055, rtol=1e-12)
    # Balls whose centres are 1 m apart along both axes; one comes 0.4 m nearer along x, the other gets away 0.1 m along y.
    np.testing.assert_allclose(stroke.distance(jnp.array([0.4, 0, 0, 0.1])), np.hypot(0.6, 1.1) - 0.4, rtol=1e-12)
