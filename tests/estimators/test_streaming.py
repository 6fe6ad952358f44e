"""Samples in chunks: memory, rounding, and honest counts of what was spent."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from mjxgrad import estimators
from mjxgrad.objective import parameter_noise
from tests.estimators import textbook
from tests.estimators.textbook import first_and_zeroth_order, first_order, zeroth_order

POINT = jnp.array([0.5, -1.2, 0.4])


@pytest.fixture
def objective():
    return parameter_noise(textbook.bumpy, jnp.array([0.1, 0.4, 0.2]))


@pytest.mark.parametrize("chunk_size", [2, 64])
@pytest.mark.parametrize(
    ("estimator", "settings"),
    [
        (first_order, {}),
        (zeroth_order, {"baseline": "leave_one_out", "antithetic": True}),
        (zeroth_order, {"baseline": "zero_noise", "antithetic": True}),
        (zeroth_order, {"baseline": "none", "antithetic": True}),
    ],
)
def test_the_size_of_chunks_changes_nothing_but_rounding(objective, key, chunk_size, estimator, settings):
    chunked, whole = (
        estimator(objective, POINT, key, num_samples=130, chunk_size=size, **settings) for size in (chunk_size, None)
    )
    # Sums of 130 terms of order one, added in another order.
    for name in ("value", "standard_error", "objective_mean", "num_finite", "num_rollouts"):
        one, other = getattr(chunked, name), getattr(whole, name)
        np.testing.assert_allclose(one, other, rtol=1e4 * jnp.finfo(POINT.dtype).eps)


def test_memory_does_not_grow_with_the_number_of_samples(objective, key):
    def temporary_bytes(num_samples: int) -> int:
        def estimate(params, key):
            return first_and_zeroth_order(objective, params, key, num_samples=num_samples, chunk_size=128)

        return jax.jit(estimate).lower(POINT, key).compile().memory_analysis().temp_size_in_bytes

    assert temporary_bytes(2**20) == temporary_bytes(2**10)


def test_sharing_rollouts_gives_what_each_estimator_gives_alone(objective, key):
    first, zeroth = first_and_zeroth_order(objective, POINT, key, num_samples=50)
    alone = first_order(objective, POINT, key, num_samples=50), zeroth_order(objective, POINT, key, num_samples=50)
    for shared, single in zip((first, zeroth), alone, strict=True):
        np.testing.assert_allclose(shared.value, single.value, rtol=1e-10)
        np.testing.assert_allclose(shared.standard_error, single.standard_error, rtol=1e-10)


@pytest.mark.parametrize(
    ("estimator", "settings", "rollouts", "gradients"),
    [
        (first_order, {}, 40, 40),
        (zeroth_order, {"baseline": "zero_noise"}, 41, 0),
        (zeroth_order, {"antithetic": True}, 40, 0),
        (eqx.filter_jit(estimators.alpha_order), {}, 40, 40),
        (lambda *a, **k: first_and_zeroth_order(*a, **k)[0], {}, 40, 40),
    ],
)
def test_rollouts_are_counted_as_they_are_spent(key, estimator, settings, rollouts, gradients):
    calls = []

    def counted(x: Float[Array, " 1"]) -> Float[Array, ""]:
        jax.debug.callback(lambda _: calls.append(1), x)
        return x[0] ** 3

    estimate = estimator(parameter_noise(counted, 0.1), jnp.array([0.3]), key, num_samples=40, **settings)
    jax.block_until_ready(estimate.value)
    jax.effects_barrier()
    assert len(calls) == rollouts == estimate.num_rollouts
    assert estimate.num_gradient_rollouts == gradients
    assert estimate.num_samples == estimate.num_finite == 40


@pytest.mark.parametrize("offset", [1e6, -3e4])
def test_adding_a_large_constant_changes_nothing(offset):
    """Neither the estimate nor its variance: sums are kept about the mean, also in float32."""
    point = jnp.array([0.3], jnp.float32)

    def estimates(constant):
        # Costs are multiples of 1/8, so that adding the constant loses nothing in float32.
        objective = parameter_noise(lambda x: jnp.round(8 * 30 * x[0] ** 2) / 8 + constant, jnp.float32(0.1))
        return zeroth_order(objective, point, jax.random.key(0), num_samples=5000, chunk_size=100)

    plain, shifted = estimates(jnp.float32(0)), estimates(jnp.float32(offset))
    assert plain.value.dtype == jnp.float32
    # Only the order of the terms of sums over 5000 samples differs.
    np.testing.assert_allclose(shifted.value, plain.value, rtol=1e-4)
    np.testing.assert_allclose(shifted.variance, plain.variance, rtol=1e-4)


@pytest.mark.parametrize("antithetic", [False, True])
@pytest.mark.parametrize("baseline", ["leave_one_out", "zero_noise", "none"])
def test_each_baseline_is_what_it_is_called(key, baseline, antithetic):
    """The formula, term by term, from the same noise, which each sample has by its number: g = mean of (f - b) s."""
    point, units = 0.3, 10 // (1 + antithetic)
    objective = parameter_noise(textbook.quadratic_sine, 0.1, dim=1)
    noise = np.array([objective.sample_noise(jax.random.fold_in(key, i))[0] for i in range(units)])
    noise = np.stack([noise, -noise] if antithetic else [noise], axis=1)
    x = point + noise
    costs, scores = x**2 + 0.1 * np.sin(20 * x), noise / 0.01
    others = (costs.mean(axis=1).sum() - costs.mean(axis=1)) / (units - 1)
    baselines = {"leave_one_out": others, "zero_noise": point**2 + 0.1 * np.sin(20 * point), "none": 0.0}
    terms = ((costs - np.broadcast_to(baselines[baseline], units)[:, None]) * scores).mean(axis=1)
    estimate = zeroth_order(
        objective, jnp.array([point]), key, num_samples=10, baseline=baseline, antithetic=antithetic
    )
    np.testing.assert_allclose(estimate.value[0], terms.mean(), rtol=1e-9)
    if baseline != "leave_one_out":
        np.testing.assert_allclose(estimate.standard_error[0], terms.std(ddof=1) / np.sqrt(units), rtol=1e-9)
