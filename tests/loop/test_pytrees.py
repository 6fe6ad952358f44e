"""Parameters that are a dict or an equinox module come back as one, and the numbers are those of the vector."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from tests.loop import problems
from tests.loop.problems import START


class Gains(eqx.Module):
    """Parameters beside what is none: a function and a count."""

    stiff: jax.Array
    loose: jax.Array
    activation: object
    count: int


FORMS = {
    "matrix": (lambda x: x[:, None], lambda form: form[:, 0]),
    "dict": (lambda x: {"a": x[:1], "b": x[1]}, lambda form: jnp.append(form["a"], form["b"])),
    "module": (
        lambda x: Gains(x[:1], x[1], jnp.tanh, 3),
        lambda form: jnp.append(form.stiff, form.loose) if form.activation is jnp.tanh and form.count == 3 else None,
    ),
}
SETTINGS = {"estimator": problems.first_order, "optimiser": optax.adam(0.05)}


@pytest.fixture(params=FORMS)
def form(request):
    """The way to a form and back, and the cost of it."""
    there, back = FORMS[request.param]
    return there, back, lambda tree: problems.bowl(back(tree))


@pytest.mark.parametrize("is_annealed", [False, True])
def test_the_run_is_that_of_the_vector(key, form, is_annealed):
    there, back, cost = form
    options = {"num_steps": 12, "annealing": optax.exponential_decay(1.0, 4, 0.5) if is_annealed else None, **SETTINGS}

    def smoothed(function):
        noisy = mg.parameter_noise(function, 0.1, dim=2)
        return (lambda scale: noisy.with_stddev(0.1 * scale)) if is_annealed else noisy

    vector = mg.optimise(smoothed(problems.bowl), START, key, evaluate=problems.bowl, **options)
    tree = mg.optimise(smoothed(cost), there(START), key, evaluate=cost, **options)
    assert jax.tree.structure(tree.params) == jax.tree.structure(there(START))
    # Two programs may be compiled to different rounding.
    np.testing.assert_allclose(back(tree.params), vector.params, rtol=1e-12)
    np.testing.assert_allclose(back(tree.best_params), vector.best_params, rtol=1e-12)
    np.testing.assert_allclose(tree.history.noise_free_cost, vector.history.noise_free_cost, rtol=1e-10)


@pytest.mark.parametrize("form", ["dict", "module"], indirect=True)  # a matrix would be one vector per seed
def test_many_seeds_have_their_axis_first(key, form):
    there, back, cost = form
    keys = jax.random.split(key, 3)
    result = mg.optimise(mg.parameter_noise(cost, 0.1), there(START), keys, num_steps=3, **SETTINGS)
    vector = mg.optimise(mg.parameter_noise(problems.bowl, 0.1), START, keys, num_steps=3, **SETTINGS)
    stacked = eqx.filter_vmap(back)(result.params)
    np.testing.assert_allclose(stacked, vector.params, rtol=1e-12)


def test_a_transformation_takes_and_gives_the_form(key, form):
    there, back, cost = form
    transformation = mg.estimated_gradient(mg.parameter_noise(cost, 0.1, dim=2), key, **SETTINGS)
    result = mg.optimise(problems.objective, START, key, num_steps=3, **SETTINGS)
    params = there(START)
    state = transformation.init(params)
    for _ in range(3):
        change, state = transformation.update(None, state, params)
        params = eqx.apply_updates(params, change)
    np.testing.assert_allclose(back(params), result.params, rtol=1e-12)
