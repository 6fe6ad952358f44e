"""Whether derivatives explain costs, pair by pair."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mjxgrad.estimators.samples import Group, plan_by_noise, sample
from mjxgrad.estimators.unbiased import gram, secant_sums
from mjxgrad.objective import parameter_noise

STDDEVS = jnp.array([0.1, 0.2])
POINT = jnp.array([0.05, -0.3])


def sums_of(function, key, num_samples=40):
    objective = parameter_noise(function, STDDEVS).sized_for(POINT)
    plan = plan_by_noise(objective, num_samples, None)

    @eqx.filter_jit
    def run(key):
        samples = Group.of(sample(objective, POINT, key, plan, jnp.arange(num_samples)))
        return secant_sums(samples, gram(samples)), samples

    return run(key)


def test_the_sums_are_those_of_the_definition(key):
    def cost(x):
        return jnp.sin(9 * x[0]) * x[1] + jnp.where(x[0] > 0, 0.2, 0.0)

    sums, samples = sums_of(cost, key)
    x = np.asarray(POINT + samples.noise)
    costs, slopes = map(np.asarray, jax.jit(jax.vmap(jax.value_and_grad(cost)))(x))
    missed = 0.0
    for j in range(40):
        for k in set(range(40)) - {j}:
            rest = costs[j] - costs[k] - (slopes[j] + slopes[k]) @ (x[j] - x[k]) / 2
            missed += rest**2 / 2
    np.testing.assert_allclose(sums.missed, missed, rtol=1e-9)
    assert sums.pairs == 40 * 39


def test_a_sample_without_derivative_is_compared_with_none(key):
    """The root below zero has no derivative; what remains is smooth enough to be explained."""
    sums, samples = sums_of(lambda x: x[1] + jnp.sqrt(jnp.where(x[0] > 0, 1.0, x[0] * 0)), key)
    kept = int(samples.has_derivative.sum())
    assert 0 < kept < 40
    assert sums.pairs == kept * (kept - 1)
