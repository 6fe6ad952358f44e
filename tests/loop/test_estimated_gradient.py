"""The same steps in a loop of one's own."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from tests.loop import problems
from tests.loop.problems import CENTRE, CURVATURE, START, made_up


def loop(transformation, num_steps):
    def step(carry, _):
        params, state = carry
        change, state = transformation.update(None, state, params)
        return (optax.apply_updates(params, change), state), params

    return jax.jit(lambda p: jax.lax.scan(step, (p, transformation.init(p)), length=num_steps)[0])(START)


def test_the_trajectory_is_that_of_optimise(key):
    settings = {"optimiser": optax.adam(0.05), "annealing": optax.exponential_decay(1.0, 10, 0.5)}

    def smoothed(scale):
        return problems.objective.with_stddev(0.1 * scale)

    result = mg.optimise(smoothed, START, key, estimator=problems.first_order, num_steps=25, **settings)
    params, state = loop(mg.estimated_gradient(smoothed, key, estimator=problems.first_order, **settings), 25)
    # Two programs may be compiled to different rounding.
    np.testing.assert_allclose(params, result.params, rtol=1e-12)
    np.testing.assert_allclose(jnp.linalg.norm(state.estimate.value), result.history.gradient_norm[-1], rtol=1e-9)
    assert state.step == 25
    np.testing.assert_allclose(state.scale, result.history.scale[-1])


def test_without_an_optimiser_it_is_the_gradient_for_a_chain(key):
    transformation = optax.chain(
        mg.estimated_gradient(problems.objective, key, estimator=problems.exact), optax.sgd(0.1)
    )
    params, _ = loop(transformation, 30)
    np.testing.assert_allclose(params, CENTRE + (START - CENTRE) * (1 - 0.1 * CURVATURE) ** 30, rtol=1e-12)


def test_the_gradient_of_anything_else_is_added(key):
    transformation = mg.estimated_gradient(problems.objective, key, estimator=problems.exact)
    change, _ = transformation.update(jnp.array([0.25, 0.5]), transformation.init(START), START)
    np.testing.assert_allclose(change, CURVATURE * (START - CENTRE) + jnp.array([0.25, 0.5]), rtol=1e-12)


def test_an_estimate_that_is_not_finite_is_a_zero_update_and_counted(key):
    transformation = mg.estimated_gradient(problems.objective, key, estimator=lambda *_: made_up([jnp.nan, 1.0]))
    change, state = transformation.update(None, transformation.init(START), START)
    np.testing.assert_array_equal(change, 0)
    assert state.num_skipped == 1
    assert np.isnan(state.estimate.value[0])
    with pytest.raises(ValueError, match="params must be given to update"):
        transformation.update(None, transformation.init(START))
