"""Parameters that are a dict or an equinox module: the estimate has their form, and the numbers are those of the vector."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad import estimators
from mjxgrad.objective import parameter_noise
from tests.estimators import textbook

VECTOR = jnp.array([0.5, -1.2, 0.4])
STDDEV = jnp.array([0.1, 0.4, 0.2])
VECTOR_OBJECTIVE = parameter_noise(textbook.bumpy, STDDEV)


class Push(eqx.Module):
    """Parameters beside what is none."""

    force: jax.Array
    place: jax.Array
    profile: object


FORMS = {"dict": {"force": VECTOR[:2], "place": VECTOR[2]}, "module": Push(VECTOR[:2], VECTOR[2], jnp.tanh)}


def leaves(tree):
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))])


OBJECTIVE = parameter_noise(lambda tree: textbook.bumpy(leaves(tree)), STDDEV)


@pytest.mark.parametrize(
    ("name", "form"),
    [*((name, "dict") for name in ("zeroth_order", "alpha_order", "control_variate")), ("first_order", "module")],
)
def test_an_estimate_has_the_form_of_the_parameters(key, name, form):
    estimator = eqx.filter_jit(getattr(estimators, name))
    tree = estimator(OBJECTIVE, FORMS[form], key, num_samples=20)
    vector = estimator(VECTOR_OBJECTIVE, VECTOR, key, num_samples=20)
    arrays = eqx.filter(FORMS[form], eqx.is_array)
    for field in ("value", "standard_error", "covariance_diagonal"):
        found = getattr(tree, field)
        assert jax.tree.structure(found) == jax.tree.structure(arrays)
        np.testing.assert_allclose(leaves(found), getattr(vector, field), rtol=1e-10)
    np.testing.assert_allclose(tree.variance, vector.variance, rtol=1e-10)
    assert eqx.apply_updates(FORMS[form], tree.value) is not None


def test_both_orders_have_the_form_and_a_batch_keeps_its_variances_apart(key):
    def both(scale):
        params = jax.tree.map(lambda leaf: leaf * scale, FORMS["dict"])
        return estimators.first_and_zeroth_order(OBJECTIVE, params, key, num_samples=20)

    first, zeroth = jax.jit(jax.vmap(both))(jnp.array([1.0, 0.5]))
    alone = estimators.first_order(VECTOR_OBJECTIVE, 0.5 * VECTOR, key, num_samples=20)
    assert first.value["force"].shape == zeroth.value["force"].shape == (2, 2)
    np.testing.assert_allclose(first.variance[1], alone.variance, rtol=1e-10)
