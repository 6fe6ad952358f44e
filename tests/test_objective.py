"""What an estimator sees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.objective import closed_loop, open_loop, parameter_noise
from tests.estimators import textbook

STDDEV = 0.3


@pytest.fixture
def policy_params():
    return {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.25])}


@pytest.fixture
def objective(policy_params):
    return closed_loop(textbook.LinearSystem(), textbook.linear_policy, STDDEV, params=policy_params)


def log_density(point, noisy):
    """Of a normal distribution, up to a constant."""
    return -(((noisy - point) / STDDEV) ** 2).sum() / 2


def test_the_score_of_parameter_noise_is_the_gradient_of_its_log_density():
    objective = parameter_noise(textbook.bumpy, STDDEV, dim=3)
    params, noise = jnp.array([0.2, 0.5, -0.1]), jnp.array([0.1, -0.4, 0.3])
    expected = jax.grad(log_density)(params, params + noise)
    np.testing.assert_allclose(objective.score(params, noise), expected, rtol=1e-6)


def test_the_score_of_a_policy_is_the_gradient_of_the_log_density_of_its_actions(objective, policy_params):
    """With the visited states and the actions taken held fixed."""
    task, params = textbook.LinearSystem(), objective.ravel(policy_params)
    noise = objective.sample_noise(jax.random.key(0))
    states = task.run(textbook.linear_policy, policy_params, noise).states
    actions = jnp.stack([textbook.linear_policy(policy_params, x) for x in states]) + noise

    def actions_log_density(flat):
        mean = jnp.stack([textbook.linear_policy(objective.unravel(flat), x) for x in states])
        return log_density(mean, actions)

    np.testing.assert_allclose(
        objective.score(params, noise), jax.grad(actions_log_density)(params), rtol=1e-6, atol=1e-6
    )


def test_value_and_score_of_a_policy_come_from_one_rollout(objective, policy_params):
    runs = []

    class Counted(textbook.LinearSystem):
        def run(self, *arguments):
            runs.append(1)
            return super().run(*arguments)

    counted = closed_loop(Counted(), textbook.linear_policy, STDDEV, params=policy_params)
    params, noise = objective.ravel(policy_params), objective.sample_noise(jax.random.key(0))
    value, score = counted.value_and_score(params, noise)
    assert len(runs) == 1
    np.testing.assert_allclose(value, objective.value(params, noise), rtol=1e-6)
    np.testing.assert_allclose(score, objective.score(params, noise), rtol=1e-6)


def test_a_policy_may_take_the_flat_vector_itself():
    objective = closed_loop(textbook.LinearSystem(), lambda flat, x: flat[:2] @ x + flat[2:], STDDEV)
    params = jnp.array([-0.3, 0.2, 0.25])
    noise = objective.sample_noise(jax.random.key(0))
    pytree = {"gain": jnp.array([[-0.3, 0.2]]), "offset": jnp.array([0.25])}
    other = closed_loop(textbook.LinearSystem(), textbook.linear_policy, STDDEV, params=pytree)
    assert objective.sized_for(params).dim == 3
    np.testing.assert_allclose(objective.value(params, noise), other.value(params, noise), rtol=1e-6)


def test_open_loop_noise_is_added_to_the_controls():
    task, controls = textbook.LinearSystem(), jnp.array([[0.4], [-0.7], [0.2], [0.9]])
    objective = open_loop(task, STDDEV)
    noise = objective.sample_noise(jax.random.key(1))
    np.testing.assert_allclose(
        objective.value(objective.ravel(controls), noise), task.run(controls + noise).cost, rtol=1e-6
    )
    np.testing.assert_allclose(objective.score(objective.ravel(controls), noise), noise[:, 0] / STDDEV**2, rtol=1e-6)


def test_noise_has_the_standard_deviation_it_is_given():
    objective = parameter_noise(textbook.bumpy, jnp.array([0.1, 1.0, 20.0]))
    noise = jax.vmap(objective.sample_noise)(jax.random.split(jax.random.key(0), 4000))
    np.testing.assert_allclose(noise.std(axis=0), [0.1, 1.0, 20.0], rtol=4 / np.sqrt(2 * 4000))


def test_zero_noise_changes_nothing():
    objective = parameter_noise(textbook.bumpy, STDDEV, dim=3)
    params = jnp.array([0.2, 0.5, -0.1])
    assert objective.value(params, objective.zero_noise()) == textbook.bumpy(params)


def test_single_precision_stays_single():
    """Noise of double precision does not turn a single-precision scene's parameters into double."""
    objective = parameter_noise(lambda x: x.sum(), STDDEV, dim=2)
    params = jnp.array([0.1, 0.2], jnp.float32)
    noise = objective.sample_noise(jax.random.key(0))
    assert objective.value(params, noise).dtype == jnp.float32
    assert objective.score(params, noise).dtype == jnp.float32


def test_noise_of_an_unknown_dimension_is_refused_by_name():
    with pytest.raises(ValueError, match="dim is not known: pass dim"):
        parameter_noise(textbook.bumpy, STDDEV).sample_noise(jax.random.key(0))
