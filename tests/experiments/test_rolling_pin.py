"""Above a bed that it does not touch the pin has no gradient; from afar it has one; the report says which."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.rolling_pin import DENT, DEPTH, Descent, Outcome, Settings, answer, rolling_pin, tables, verdict

HORIZON = 40


@pytest.fixture(scope="module")
def task():
    return rolling_pin(horizon=HORIZON)


@pytest.fixture(scope="module")
def seen(task):
    """Give cost, gradient and last position for a weight of proximity, a larger radius and a margin: one program."""

    def run(params, proximity, extra, margin):
        changed = task.with_proximity(proximity).enlarged(extra).with_softness(mg.Softness(margin=margin))
        controls = params.reshape(HORIZON, 2)
        cost, gradient = jax.value_and_grad(changed.true_cost)(params)
        return cost, gradient, mg.rollout(changed.scene, changed.state, controls).qpos[-1]

    return eqx.filter_jit(jax.vmap(run))


def _batch(seen, params, *variants):
    columns = np.array(variants).T
    return seen(jnp.broadcast_to(params, (len(variants), 2 * HORIZON)), *jnp.asarray(columns))


@pytest.mark.slow
def test_the_gradient_is_exactly_zero_where_nothing_touches_and_not_with_a_remedy(seen):
    untouched = jnp.zeros(2 * HORIZON)
    costs, gradients, _ = _batch(seen, untouched, (0, 0, 0), (0.3, 0, 0), (0, 0.04, 0), (0, 0, 0.04))
    assert not gradients[0].any()
    # The bed is flat, so the cost is 1; the distance stays at its start, so proximity adds its weight.
    np.testing.assert_allclose(costs[:2], [1, 1.3], rtol=1e-12)
    largest_by_height = np.abs(gradients[1:, 1::2]).max(axis=1)
    assert (largest_by_height > 1e-4).all()


@pytest.mark.slow
def test_a_margin_is_nothing_but_a_larger_pin(seen):
    pressed = jnp.zeros((HORIZON, 2)).at[:, 0].set(0.1).at[:, 1].set(-0.6).ravel()
    costs, gradients, last = _batch(seen, pressed, (0, 0.02, 0), (0, 0, 0.02), (0, 0, 0), (0.3, 0, 0))
    assert np.abs(last[0, 2:]).max() > 1e-3
    # The same distances to rounding, which a stiff contact may amplify.
    np.testing.assert_allclose(last[1], last[0], atol=1e-12)
    np.testing.assert_allclose(gradients[1], gradients[0], atol=1e-10)
    assert abs(costs[2] - costs[0]) > 1e-3


def test_the_cost_is_the_closed_form_of_the_bed_and_the_controls(task):
    qpos = np.zeros((HORIZON + 1, 10))
    qpos[-1, 2:] = np.arange(8) * 1e-3
    state = task.state
    trajectory = mg.Trajectory(
        qpos=jnp.asarray(qpos), qvel=jnp.zeros((HORIZON + 1, 10)), ctrl=jnp.full((HORIZON, 2), 2.0),
        observations=None, final=state, diverged=jnp.array(False), first_bad_step=jnp.array(-1, jnp.int32),
    )  # fmt: skip
    wanted = np.where(np.isin(np.arange(8), DENT), -DEPTH, 0.0)
    expected = np.sum((qpos[-1, 2:] - wanted) ** 2) / (4 * DEPTH**2) + 1e-3 * 4
    np.testing.assert_allclose(task.cost(trajectory), expected, rtol=1e-12)


def test_the_distance_is_that_to_the_nearest_cap(task):
    # The pin, radius 40 mm, is 30 mm above the third cap, radius 15 mm; moved 60 mm on it is above the fifth, here sunk.
    at_rest = np.zeros(10)
    np.testing.assert_allclose(task.cost.distance(jnp.asarray(at_rest)), 0.03, rtol=1e-12)
    moved = at_rest.copy()
    moved[[0, 2 + 4]] = 0.06, -0.05
    # Nearest is then its neighbour, 30 mm aside and 85 mm below.
    np.testing.assert_allclose(task.cost.distance(jnp.asarray(moved)), np.hypot(0.03, 0.085) - 0.055, rtol=1e-12)


def _descent(label, costs):
    heights = np.where(np.isin(np.arange(8), DENT), -DEPTH, 0.001)
    return Descent(label, np.zeros(2 * HORIZON), np.array(costs, float), 2, 0, heights)


@pytest.fixture
def outcome(task):
    descents = [
        _descent("first order", [1, 1, 1, 1]),
        _descent("margin", [1, 0.05, 0.4, 0.02]),
        _descent("zeroth order", [1, 0.9, 0.8, 0.7]),
    ]
    return Outcome(Settings(experiment="rolling_pin", num_steps=3), descents, start_gradient=0.0, task=task)


def test_the_verdict_names_what_stayed_what_solved_and_what_did_not(outcome):
    said = verdict(outcome)
    assert answer(outcome).startswith("1 of 3 ways")
    assert "its gradient is zero, exactly" in said
    assert "Solved, with a true cost below 0.1 of the untouched bed's 1, by “margin” (0.0200)" in said
    assert "Not solved by “zeroth order” (0.700)" in said
    shown = tables(outcome)[0]
    assert [row[0] for row in shown.rows] == ["first order", "margin", "zeroth order"]
    assert [row[4:6] for row in shown.rows] == [["never", ""], ["3", "6"], ["never", ""]]
    assert shown.rows[0][-1] == "1.0"  # mm
    assert shown.emphasised == frozenset({(1, 2)})
