"""Estimates, windows and a run of the experiment on long horizons."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import main
from experiments.config import ConfigurationError, load_runs
from experiments.long_horizon.measure import reference_gradient, zeroth
from experiments.long_horizon.problems import problem

STDDEV = 0.3


def costs(noise):
    """Two costs, whose means have the gradients (1, 2) and (3 σ², 0), by Stein's lemma."""
    return np.stack([5 + noise @ [1.0, 2.0] + noise[:, 1] ** 2, noise[:, 0] ** 3], axis=1)


EXACT = np.array([[1.0, 2.0], [3 * STDDEV**2, 0.0]])


@pytest.fixture(scope="module")
def noise():
    return STDDEV * np.random.default_rng(0).normal(size=(6400, 2))


def test_the_reference_is_the_gradient_and_knows_its_error(noise):
    pilot, many = noise[:400], noise[400:]
    value, error = reference_gradient(STDDEV, (pilot, costs(pilot)), (many, costs(many)))
    assert (np.abs(value - EXACT) < 4 * error).all()
    # Without its linear part the first cost is w₁² − σ²; times w₀ / σ² and w₁ / σ² it has variance 2 σ² and (15 − 6 + 1) σ².
    assert error[0] == pytest.approx(STDDEV * np.sqrt([2, 10]) / np.sqrt(6000), rel=0.1)


def test_the_zeroth_order_estimate_is_unbiased_whatever_is_added_to_the_costs(noise):
    samples = zeroth(STDDEV, noise, 1e3 + costs(noise), 16)
    repeats = samples.reshape(400, 16, 2, 2).mean(axis=1)
    error = repeats.std(axis=0, ddof=1) / np.sqrt(400)
    assert (np.abs(repeats.mean(axis=0) - EXACT) < 4 * error).all()
    assert error.max() < 0.2  # with the constant in, it would be 1e3 / 0.3 / √6400 = 40


@pytest.mark.slow
def test_windows_are_the_terms_of_the_chain_rule():
    """S' = J S + P: the tangents of windows of one segment are the P, from which those of the whole follow."""
    pendulum = problem("double_pendulum", 4)
    params, direction = 0.05 * jnp.arange(1.0, 5.0), jnp.array([1.0, -0.5, 0.3, 0.7])

    @jax.jit
    @jax.vmap
    def tangents(window):
        return jax.jvp(lambda p: pendulum.states(p, window, "discrete"), (params,), (direction,))[1]

    single, pairs, whole = tangents(jnp.array([1, 2, 4]))
    jacobians = jax.jit(lambda p: pendulum.jacobians(p, "discrete"))(params)
    expected = [single[0]]
    for time in range(1, 4):
        expected.append(jacobians[time] @ expected[-1] + single[time])
    assert np.allclose(whole, jnp.stack(expected), rtol=1e-9)
    assert np.allclose(pairs[3], jacobians[3] @ single[2] + single[3], rtol=1e-9)


@pytest.mark.parametrize(
    ("override", "sentence"), [("problems=[]", "problems"), ("confidence=1.5", "confidence"), ("size=huge", "size")]
)
def test_settings_that_cannot_be_are_a_sentence(override, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        load_runs("long_horizon", [override])


@pytest.mark.slow
def test_a_quick_run_says_where_the_orders_cross(tmp_path):
    assert main(["run", "long_horizon", "size=quick", "problems=['double_pendulum']", "--output", str(tmp_path)]) == 0
    verdict = json.loads((tmp_path / "long_horizon" / "summary.json").read_text())["verdict"]
    assert verdict.startswith("Double pendulum: at 8 rollouts an estimate, zeroth order is as good from a horizon of ")
