"""How far a step goes on the word of an estimate, and what that guarantees."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from tests.estimators import textbook
from tests.optimiser import problems
from tests.optimiser.problems import CENTRE, CURVATURE, STDDEV, made_up


def step(key, gradient, bias_bound, region, *, rate=100.0, objective=problems.objective):
    """The change of the parameters in one step of plain descent, by default far too long."""
    size = len(gradient)
    transformation = mg.estimated_gradient(
        objective,
        key,
        estimator=lambda *_: made_up(gradient, bias_bound=bias_bound),
        optimiser=optax.sgd(rate),
        trust_region=region,
    )
    return transformation.update(None, transformation.init(jnp.zeros(size)), jnp.zeros(size))[0]


@pytest.mark.parametrize(
    ("bias_bound", "share"),
    [(0.0, 1.0), (1.0, 0.8), (4.5, 0.1), (5.0, 0.0), (7.0, 0.0), (jnp.inf, 0.0), (jnp.nan, 1.0)],
)
def test_a_step_is_limited_by_what_the_bias_leaves(key, bias_bound, share):
    """The gradient has norm 5; the limit is radius * (1 - bound / 5) standard deviations of 0.1."""
    moved = step(key, [3.0, -4.0], bias_bound, mg.TrustRegion(2.0))
    np.testing.assert_allclose(moved, -2.0 * STDDEV * share * np.array([0.6, -0.8]), atol=1e-14)


def test_a_step_within_the_region_is_left_alone(key):
    moved = step(key, [3.0, -4.0], 2.5, mg.TrustRegion(2.0), rate=0.01)
    np.testing.assert_allclose(moved, [-0.03, 0.04], rtol=1e-12)


def test_no_gradient_is_no_step(key):
    np.testing.assert_array_equal(step(key, [0.0, 0.0], 0.0, mg.TrustRegion(2.0)), 0.0)


def test_the_length_is_in_units_of_each_parameter_s_noise(key):
    objective = mg.parameter_noise(problems.bowl, jnp.array([0.1, 0.4]))
    moved = step(key, [3.0, -4.0], 0.0, mg.TrustRegion(1.5), objective=objective)
    assert np.linalg.norm(moved / np.array([0.1, 0.4])) == pytest.approx(1.5)
    np.testing.assert_allclose(moved[0] / moved[1], -0.75)


def test_controls_have_the_unit_of_their_noise(key):
    objective = mg.open_loop(textbook.LinearSystem(), jnp.array([[0.1], [0.2], [0.3], [0.4]]))
    moved = step(key, [1.0, 2.0, -2.0, 0.5], 0.0, mg.TrustRegion(1.0), objective=objective)
    assert np.linalg.norm(moved / np.array([0.1, 0.2, 0.3, 0.4])) == pytest.approx(1.0)


def test_a_policy_needs_a_unit_and_takes_it(key):
    params = {"gain": jnp.zeros((1, 2)), "offset": jnp.zeros(1)}
    objective = mg.closed_loop(textbook.LinearSystem(), textbook.linear_policy, 0.1, params=params)
    with pytest.raises(ValueError, match="step_scale must be given to TrustRegion for ClosedLoop"):
        step(key, [1.0, 2.0, 2.0], 0.0, mg.TrustRegion(1.0), objective=objective)
    moved = step(key, [1.0, 2.0, 2.0], 0.0, mg.TrustRegion(1.0, step_scale=0.05), objective=objective)
    assert np.linalg.norm(moved) == pytest.approx(0.05)


def test_every_step_that_is_allowed_goes_down(key):
    """True gradients h, estimates g = h + b, bounds B ≥ ‖b‖: -g·h < 0 wherever the region leaves a step."""
    gradient_key, bias_key, bound_key = jax.random.split(key, 3)
    truth = jax.random.normal(gradient_key, (2000, 3))
    bias = jax.random.normal(bias_key, (2000, 3)) * jnp.exp(jax.random.normal(bound_key, (2000, 1)))
    bound = jnp.linalg.norm(bias, axis=1) * 1.0001
    region = mg.TrustRegion(0.3, step_scale=1.0)
    moved = jax.vmap(lambda g, b: region.limit(-g, g, b, problems.objective))(truth + bias, bound)
    is_allowed = jnp.linalg.norm(moved, axis=1) > 0
    slope = (moved * truth).sum(axis=1)
    assert 0.2 < is_allowed.mean() < 0.8
    assert (slope[is_allowed] < 0).all()
    # What is refused would often have gone up.
    assert ((truth + bias) * truth).sum(axis=1)[~is_allowed].min() < 0


def test_a_radius_that_is_safe_without_bias_is_safe_with_it(key):
    """On a bowl of curvature L, with r < 2‖g‖/L: the worst bias, B along g, still lets the cost fall."""
    curvature, gradient = 4.0, jnp.array([0.6, 0.8])
    radius = 0.99 * 2 / curvature
    region = mg.TrustRegion(radius, step_scale=1.0)
    for bound in (0.0, 0.3, 0.9):
        moved = region.limit(-100 * gradient, gradient, jnp.asarray(bound), problems.objective)
        truth = (1 - bound) * gradient
        assert truth @ moved + curvature / 2 * moved @ moved < 0


def test_a_bias_that_turns_the_gradient_round_does_no_harm(key):
    """The estimate points away from the minimum and says by how much it may: the run stays, without it it is lost."""

    def turned(objective, params, key):
        truth = CURVATURE * (params - CENTRE)
        return made_up(-0.5 * truth, bias_bound=1.5 * jnp.linalg.norm(truth))

    settings = {"estimator": turned, "optimiser": optax.sgd(0.1), "num_steps": 40}
    start = jnp.zeros(2)
    kept = mg.optimise(problems.objective, start, key, trust_region=mg.TrustRegion(1.0), **settings)
    lost = mg.optimise(problems.objective, start, key, **settings)
    np.testing.assert_array_equal(kept.params, start)
    assert problems.bowl(lost.params) > 10 * problems.bowl(start)


def test_a_radius_without_meaning_is_refused():
    with pytest.raises(ValueError, match="radius must be positive"):
        mg.TrustRegion(0.0)
