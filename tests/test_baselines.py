"""The other methods, in the same loop: against closed forms, with rollouts counted alike."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import mjxgrad as mg
from mjxgrad import baselines
from mjxgrad.baselines import without_action_noise
from tests.estimators import textbook

CENTRE = jnp.array([1.0, -2.0])
START = jnp.array([0.0, 0.5])


def bowl(x):
    return ((x - CENTRE) ** 2 * jnp.array([0.5, 1.5])).sum()


objective = mg.parameter_noise(bowl, 0.3, dim=2)

METHODS = {
    "cross_entropy": functools.partial(
        baselines.cross_entropy, num_samples=40, num_elite=8, stddev=1.0, min_stddev=0.05
    ),
    "mppi": functools.partial(baselines.mppi, num_samples=40),
    "predictive_sampling": functools.partial(baselines.predictive_sampling, num_samples=40),
}


@pytest.fixture(scope="module", params=METHODS)
def both(request):
    """Two seeds in one program."""
    keys = jax.random.split(jax.random.key(4), 2)
    return METHODS[request.param](objective, START, keys, num_steps=60, evaluate=bowl, evaluate_every=1)


def test_every_method_ends_at_the_minimum(both):
    assert np.all(both.best_cost < 0.02)
    assert np.all(both.final_cost < 0.1)
    assert np.all(both.stopped == mg.Stopped.finished)
    assert both.params.shape == (2, 2)
    assert not np.array_equal(both.params[0], both.params[1])


def test_every_candidate_is_counted(both):
    np.testing.assert_array_equal(both.history.num_rollouts, np.broadcast_to(40 * np.arange(1, 61), (2, 60)))
    assert np.all(both.num_gradient_rollouts == 0)


def test_predictive_sampling_never_goes_up(key):
    result = METHODS["predictive_sampling"](objective, START, key, num_steps=60, evaluate=bowl, evaluate_every=1)
    costs = np.append(result.history.noise_free_cost, result.final_cost)
    assert np.all(np.diff(costs) <= 0)


def test_cross_entropy_fits_a_truncated_gaussian(key):
    """On a slope the elite is the lower tail: mean -σφ(z)/ρ and variance σ²(1 - zφ(z)/ρ - (φ(z)/ρ)²), z = Φ⁻¹(ρ).

    The second step moves by the same in units of the first one's σ, by which that is seen, too.
    """
    share, stddev, keep = 0.2, 0.7, 0.25
    z = norm.ppf(share)
    hazard = norm.pdf(z) / share
    fitted = keep + (1 - keep) * np.sqrt(1 - z * hazard - hazard**2)
    expected = -(1 - keep) * stddev * hazard * (1 + fitted)
    result = baselines.cross_entropy(
        mg.parameter_noise(lambda x: x[0], 1.0),
        jnp.zeros(1),
        key,
        num_samples=50_000,
        num_elite=10_000,
        num_steps=2,
        stddev=stddev,
        keep=keep,
    )
    # Mean and deviation of ten thousand elite: each step is within about σ/100 of the limit.
    np.testing.assert_allclose(result.params[0], expected, atol=0.03 * stddev)


def test_a_width_is_not_let_below_its_minimum(key):
    cost = mg.parameter_noise(lambda x: (x**2).sum(), 1.0)
    method = functools.partial(
        baselines.cross_entropy, cost, jnp.zeros(1), key, num_samples=20, num_elite=4, num_steps=60
    )
    assert method().history.step_norm[-1] < 1e-6
    # Then the mean cost of the candidates is about the square of the width.
    assert 0.08 < np.sqrt(method(min_stddev=0.1).history.cost[-20:].mean()) < 0.15


def test_mppi_is_the_mean_of_a_tilted_gaussian(key):
    """exp(-x²/2λ) times N(μ, σ²) is Gaussian about μ / (1 + σ²/λ)."""
    stddev, temperature = 0.5, 0.4
    result = baselines.mppi(
        mg.parameter_noise(lambda x: 0.5 * x[0] ** 2, 1.0),
        jnp.array([0.8]),
        key,
        num_samples=50_000,
        num_steps=1,
        temperature=temperature,
        is_relative=False,
        stddev=stddev,
    )
    np.testing.assert_allclose(result.params[0], 0.8 / (1 + stddev**2 / temperature), atol=4 * stddev / np.sqrt(20_000))


def test_a_relative_temperature_does_not_know_the_unit_of_the_cost(key):
    scaled = mg.parameter_noise(lambda x: 1e4 * bowl(x) - 7e3, 0.3, dim=2)
    runs = [METHODS["mppi"](cost, START, key, num_steps=5, temperature=0.5).params for cost in (objective, scaled)]
    np.testing.assert_allclose(*runs, rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_candidates_that_are_not_finite_are_counted_and_never_followed(key, method):
    """Half of the plane is NaN and would be the better half."""
    cost = mg.parameter_noise(lambda x: jnp.where(x[0] > 0.5, jnp.nan, bowl(x)), 0.3, dim=2)
    result = METHODS[method](cost, START, key, num_steps=30)
    assert result.params[0] <= 0.5
    assert np.abs(result.params[1] + 2) < 0.3
    assert 0 < result.history.finite_fraction.min() < 1


@pytest.mark.parametrize("method", METHODS)
def test_nothing_finite_is_no_step(key, method):
    cost = mg.parameter_noise(lambda x: x.sum() * jnp.nan, 0.3, dim=2)
    result = METHODS[method](cost, START, key, num_steps=30, patience=3)
    assert result.stopped == mg.Stopped.not_finite
    assert result.num_rollouts == 120
    np.testing.assert_array_equal(result.params, START)


class RandomStart(textbook.LinearSystem):
    def sample_start(self, key):
        return self.start + jax.random.normal(key, (2,))


def test_candidates_have_starts_of_their_own_and_no_noise_on_actions(key):
    cost = mg.open_loop(RandomStart(), 0.1)
    actions, starts = jax.vmap(lambda k: without_action_noise(cost, k))(jax.random.split(key, 50))
    np.testing.assert_array_equal(actions, 0)
    assert len(np.unique(starts[:, 0])) == 50


def test_a_method_is_resumed(tmp_path, key):
    method = functools.partial(METHODS["cross_entropy"], objective, START, key, num_steps=20)

    def kill(step, _):
        if step >= 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method(checkpoint=tmp_path / "run.npz", log=kill)
    resumed = method(checkpoint=tmp_path / "run.npz")
    straight = method()
    np.testing.assert_array_equal(resumed.params, straight.params)
    np.testing.assert_array_equal(resumed.history.cost, straight.history.cost)


@pytest.mark.parametrize(
    ("method", "settings", "sentence"),
    [
        (
            baselines.cross_entropy,
            {"num_elite": 41},
            "num_elite must be at least 2 and at most num_samples = 40, got 41",
        ),
        (baselines.cross_entropy, {"num_elite": 4, "keep": 1.0}, "keep must be at least 0 and below 1"),
        (baselines.cross_entropy, {"num_elite": 4, "min_stddev": -1.0}, "min_stddev must be at least 0"),
        (baselines.mppi, {"temperature": 0.0}, "temperature must be positive"),
        (baselines.mppi, {"stddev": -0.1}, "stddev must be positive"),
        (baselines.predictive_sampling, {"stddev": jnp.ones(3)}, "stddev must be one number or 2"),
    ],
)
def test_settings_without_meaning_are_refused(key, method, settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        method(objective, START, key, num_samples=40, num_steps=1, **settings)


POLICY = {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.25])}


def closed_loop(stddev=0.3):
    return mg.closed_loop(textbook.LinearSystem(), textbook.linear_policy, stddev, params=POLICY)


def test_a_policy_needs_a_width(key):
    with pytest.raises(ValueError, match="stddev must be given for ClosedLoop"):
        baselines.mppi(closed_loop(), jnp.zeros(3), key, num_samples=4, num_steps=1)
