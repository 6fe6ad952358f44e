"""Linear policies, and networks of equinox in their place."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mjxgrad as mg
from mjxgrad.rollouts import State
from tests.estimators import textbook

STATE = jnp.array([0.7, -0.4])


def affine(gain, offset=None):
    """Return the layer of a gain and an offset."""
    gain = jnp.asarray(gain)
    layer = eqx.nn.Linear(gain.shape[1], gain.shape[0], use_bias=offset is not None, key=jax.random.key(0))
    offset = None if offset is None else jnp.asarray(offset)
    return eqx.tree_at(lambda x: (x.weight, x.bias), layer, (gain, offset), is_leaf=lambda x: x is None)


def test_a_linear_policy_is_a_gain_and_an_offset():
    policy, zero = mg.linear_policy(2, 3)
    assert zero.weight.shape == (3, 2)
    np.testing.assert_array_equal(policy(zero, STATE), 0)
    gain, offset = np.array([[1.0, 2.0], [0.5, -1.0], [0.0, 3.0]]), np.array([0.1, 0.2, -0.3])
    np.testing.assert_allclose(policy(affine(gain, offset), STATE), gain @ STATE + offset)
    _, params = mg.linear_policy(2, 3, bias=False)
    assert [leaf.shape for leaf in jax.tree.leaves(params)] == [(3, 2)]
    np.testing.assert_allclose(policy(affine(gain), STATE), gain @ STATE)


def test_of_a_scene_s_state_positions_velocities_and_activations_are_observed():
    state = State(jnp.array([1.0, 2.0]), jnp.array([3.0]), jnp.array([4.0]), jnp.array(9.0), jnp.array([8.0]))
    policy, _ = mg.linear_policy(4, 4)
    np.testing.assert_array_equal(policy(affine(jnp.eye(4)), state), [1, 2, 3, 4])


def test_what_is_observed_can_be_chosen():
    policy, _ = mg.linear_policy(1, 1, observe=lambda state: state[1:] ** 2)
    np.testing.assert_allclose(policy(affine([[10.0]]), STATE), [1.6])


def test_a_network_closes_a_loop_and_is_differentiated_by_its_noise(key):
    params = eqx.nn.MLP(2, 1, 5, 2, activation=jnp.tanh, key=key)
    objective = mg.closed_loop(textbook.LinearSystem(), lambda net, state: net(state), 0.3, params=params)
    flat, noise = objective.ravel(params) + 0.1, objective.sample_noise(key)

    @jax.jit
    def both(flat):
        found = objective.differentiate(flat, noise)
        return found.pull_back(found.gradient_by_noise), jax.grad(objective.value)(flat, noise)

    pulled_back, gradient = both(flat)
    assert np.abs(gradient).min() > 1e-6
    np.testing.assert_allclose(pulled_back, gradient, rtol=1e-9)
