"""What an estimator sees."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.objective import Objective, closed_loop, open_loop, parameter_noise
from tests.estimators import textbook
from tests.estimators.textbook import CONTROLS, POLICY_PARAMS, RandomStart

STDDEV = 0.3


@pytest.fixture
def objective():
    return closed_loop(textbook.LinearSystem(), textbook.linear_policy, STDDEV, params=POLICY_PARAMS)


def log_density(point, noisy):
    """Of a normal distribution, up to a constant."""
    return -(((noisy - point) / STDDEV) ** 2).sum() / 2


def test_the_score_of_parameter_noise_is_the_gradient_of_its_log_density():
    objective = parameter_noise(textbook.bumpy, STDDEV, dim=3)
    params, noise = jnp.array([0.2, 0.5, -0.1]), jnp.array([0.1, -0.4, 0.3])
    expected = jax.grad(log_density)(params, params + noise)
    np.testing.assert_allclose(objective.score(params, noise), expected, rtol=1e-6)


def test_the_score_of_a_policy_is_the_gradient_of_the_log_density_of_its_actions(objective):
    """With the visited states and the actions taken held fixed."""
    task, params = textbook.LinearSystem(), objective.ravel(POLICY_PARAMS)
    noise = objective.sample_noise(jax.random.key(0))
    states = task.run(textbook.linear_policy, POLICY_PARAMS, noise).states
    actions = jnp.stack([textbook.linear_policy(POLICY_PARAMS, x) for x in states]) + noise

    def actions_log_density(flat):
        mean = jnp.stack([textbook.linear_policy(objective.unravel(flat), x) for x in states])
        return log_density(mean, actions)

    np.testing.assert_allclose(
        objective.score(params, noise), jax.grad(actions_log_density)(params), rtol=1e-6, atol=1e-6
    )


def test_value_and_score_of_a_policy_come_from_one_rollout(objective):
    runs = []

    class Counted(textbook.LinearSystem):
        def run(self, *arguments):
            runs.append(1)
            return super().run(*arguments)

    counted = closed_loop(Counted(), textbook.linear_policy, STDDEV, params=POLICY_PARAMS)
    params, noise = objective.ravel(POLICY_PARAMS), objective.sample_noise(jax.random.key(0))
    value, score = counted.value_and_score(params, noise)
    assert len(runs) == 1
    np.testing.assert_allclose(value, objective.value(params, noise), rtol=1e-6)
    np.testing.assert_allclose(score, objective.score(params, noise), rtol=1e-6)


def test_a_policy_may_take_the_flat_vector_itself():
    objective = closed_loop(textbook.LinearSystem(), lambda flat, x: flat[:2] @ x + flat[2:], STDDEV)
    params = jnp.array([-0.3, 0.2, 0.25])
    noise = objective.sample_noise(jax.random.key(0))
    other = closed_loop(textbook.LinearSystem(), textbook.linear_policy, STDDEV, params=POLICY_PARAMS)
    assert objective.sized_for(params).dim == 3
    np.testing.assert_allclose(objective.value(params, noise), other.value(params, noise), rtol=1e-6)


def test_open_loop_noise_is_added_to_the_controls():
    task = textbook.LinearSystem()
    objective = open_loop(task, STDDEV)
    params, noise = objective.ravel(CONTROLS), objective.sample_noise(jax.random.key(1))
    np.testing.assert_allclose(objective.value(params, noise), task.run(CONTROLS + noise).cost, rtol=1e-6)
    np.testing.assert_allclose(objective.score(params, noise), noise[:, 0] / STDDEV**2, rtol=1e-6)


def test_noise_has_the_standard_deviation_it_is_given():
    objective = parameter_noise(textbook.bumpy, jnp.array([0.1, 1.0, 20.0]))
    noise = jax.vmap(objective.sample_noise)(jax.random.split(jax.random.key(0), 4000))
    np.testing.assert_allclose(noise.std(axis=0), [0.1, 1.0, 20.0], rtol=4 / np.sqrt(2 * 4000))


def test_single_precision_stays_single():
    """Noise of double precision does not turn a single-precision scene's parameters into double."""
    objective = parameter_noise(lambda x: x.sum(), STDDEV, dim=2)
    params = jnp.array([0.1, 0.2], jnp.float32)
    noise = objective.sample_noise(jax.random.key(0))
    assert objective.value(params, noise).dtype == jnp.float32
    assert objective.score(params, noise).dtype == jnp.float32


class Laplace(Objective):
    """Noise that is not Gaussian, known by its density alone: exp(-|w|)/2 on each parameter."""

    dim: int | None = eqx.field(static=True, default=3)

    def sample_noise(self, key):
        return jax.random.laplace(key, (3,))

    def value(self, params, noise):
        return textbook.bumpy(params + noise)

    def score(self, params, noise):
        return jnp.sign(noise)


def objectives():
    """One of each kind, with a point."""
    closed = closed_loop(textbook.LinearSystem(), textbook.linear_policy, STDDEV, params=POLICY_PARAMS)
    return {
        "parameters": (parameter_noise(textbook.bumpy, STDDEV, dim=3), jnp.array([0.2, 0.5, -0.1])),
        "open_loop": (open_loop(RandomStart(), STDDEV), CONTROLS.ravel()),
        "closed_loop": (closed, closed.ravel(POLICY_PARAMS)),
        "random_start": (eqx.tree_at(lambda o: o.task, closed, RandomStart()), closed.ravel(POLICY_PARAMS)),
        "laplace": (Laplace(), jnp.array([0.2, 0.5, -0.1])),
    }


@pytest.mark.parametrize("name", objectives())
def test_pulled_back_the_derivative_by_noise_is_the_first_order_gradient_and_the_score_the_score(name, key):
    objective, params = objectives()[name]
    noise = objective.sample_noise(key)
    found = eqx.filter_jit(objective.differentiate)(params, noise)
    gradient = jax.jit(jax.grad(objective.value))(params, noise)
    np.testing.assert_allclose(found.cost, objective.value(params, noise), rtol=1e-14)
    # The same sum of the same terms in another order.
    np.testing.assert_allclose(found.pull_back(found.gradient_by_noise), gradient, rtol=1e-12)
    np.testing.assert_allclose(found.pull_back(found.noise_score), objective.score(params, noise), rtol=1e-14)


def test_the_derivative_by_noise_goes_through_the_whole_closed_loop(objective, key):
    """The cost is quadratic in the noise, for which central differences are exact at any distance."""
    params, noise = objective.ravel(POLICY_PARAMS), objective.sample_noise(key)
    cost = jax.vmap(lambda step: objective.value(params, noise + step.reshape(4, 1)))
    slopes = (cost(jnp.eye(4)) - cost(-jnp.eye(4))) / 2
    np.testing.assert_allclose(objective.differentiate(params, noise).gradient_by_noise, slopes, rtol=1e-10)


def test_a_batch_of_pull_backs_can_be_kept_and_applied_later(objective, key):
    """Out of one compiled function, into another, and through a branch: it is a pytree that equals its like."""
    params = objective.ravel(POLICY_PARAMS)
    noises = jax.vmap(objective.sample_noise)(jax.random.split(key, 3))
    batch = jax.jit(jax.vmap(lambda noise: objective.differentiate(params, noise)))(noises)
    again = jax.jit(jax.vmap(lambda noise: objective.differentiate(params, noise)))(noises)
    pull_backs = jax.lax.cond(batch.cost.sum() > 0, lambda: batch.pull_back, lambda: again.pull_back)
    scores = jax.jit(jax.vmap(lambda pull_back, vector: pull_back(vector)))(pull_backs, batch.noise_score)
    np.testing.assert_allclose(scores, [objective.score(params, noise) for noise in noises], rtol=1e-12)


def test_a_kept_pull_back_holds_nothing_of_the_task():
    """A vmapped function that returns it would copy the scene for every sample."""
    objective = closed_loop(RandomStart(), textbook.linear_policy, STDDEV, params=POLICY_PARAMS)
    params = objective.ravel(POLICY_PARAMS)
    found = objective.differentiate(params, objective.zero_noise())
    # Three parameters and the four states of the plane that were visited.
    assert sorted(leaf.shape for leaf in jax.tree.leaves(found.pull_back)) == [(3,), (4, 2)]


def test_the_noise_is_told_by_component():
    stddev = jnp.array([[0.1], [0.2], [0.3], [0.4]])
    objective = open_loop(textbook.LinearSystem(), stddev)
    found = objective.differentiate(CONTROLS.ravel(), stddev * jnp.array([[1.0], [2.0], [-1.0], [0.5]]))
    assert objective.noise_shape == (4, 1)
    np.testing.assert_allclose(found.noise_stddev, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(found.noise_score, [1 / 0.1, 2 / 0.2, -1 / 0.3, 0.5 / 0.4])


def test_noise_of_unknown_kind_has_no_standard_deviation(key):
    objective = Laplace()
    assert np.isnan(objective.differentiate(jnp.zeros(3), objective.sample_noise(key)).noise_stddev).all()
    with pytest.raises(ValueError, match="Laplace must have a stddev to change"):
        objective.with_stddev(0.2)


@pytest.mark.parametrize("name", ["parameters", "open_loop", "closed_loop"])
def test_other_noise_is_the_old_one_scaled_and_checked_like_it(name, key):
    objective, _ = objectives()[name]
    for wrong in (-0.1, jnp.ones(7)):
        if name != "open_loop":
            with pytest.raises(ValueError, match="stddev must"):
                objective.with_stddev(wrong)
    noises = jax.vmap(lambda scale: objective.with_stddev(scale * STDDEV).sample_noise(key))(jnp.array([0.5, 2.0]))
    once = objective.sample_noise(key)
    halved, doubled = (jax.tree.map(lambda leaf, i=i: leaf[i], noises) for i in (0, 1))
    halved, doubled, once = (n[0] if isinstance(n, tuple) else n for n in (halved, doubled, once))
    np.testing.assert_allclose(halved, once / 2, rtol=1e-12)
    np.testing.assert_allclose(doubled, once * 2, rtol=1e-12)


def test_a_rule_without_forward_mode_is_differentiated_in_reverse():
    @jax.custom_vjp
    def cube(x):
        return x**3

    cube.defvjp(lambda x: (x**3, x), lambda x, g: (3 * x**2 * g,))
    objective = parameter_noise(lambda x: cube(x[0]), STDDEV, dim=1)
    found = objective.differentiate(jnp.array([2.0]), jnp.array([1.0]))
    np.testing.assert_allclose(found.gradient_by_noise, [27.0])
