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
    assert str(tree) == str(vector)


def test_an_estimate_is_printed_in_numbers_and_a_long_one_by_its_norm(key):
    """Of a cost 3 x by exact first order; of 16 such the norm is 12. A traced one has no numbers."""
    slope = parameter_noise(lambda x: 3 * x.sum(), 0.1)
    one, many = (estimators.first_order(slope, jnp.zeros(size), key, num_samples=4) for size in (1, 16))
    assert str(one).startswith("Gradient 3 ± 0; cost ")
    assert str(many).startswith("Gradient of 16 numbers, of norm 12 ± 0; cost ")
    assert str(one).endswith("; 4 rollouts: every sample was finite. α is 1: the estimator leaves no choice, or α was "
        "given. ± is a standard error.")  # fmt: skip
    jax.jit(lambda x: str(estimators.first_order(slope, x, key, num_samples=4)) and x)(jnp.zeros(1))


def test_both_orders_have_the_form_and_a_batch_keeps_its_variances_apart(key):
    def both(scale):
        params = jax.tree.map(lambda leaf: leaf * scale, FORMS["dict"])
        return estimators.first_and_zeroth_order(OBJECTIVE, params, key, num_samples=20)

    first, zeroth = jax.jit(jax.vmap(both))(jnp.array([1.0, 0.5]))
    alone = estimators.first_order(VECTOR_OBJECTIVE, 0.5 * VECTOR, key, num_samples=20)
    assert first.value["force"].shape == zeroth.value["force"].shape == (2, 2)
    np.testing.assert_allclose(first.variance[1], alone.variance, rtol=1e-10)
