"""A policy leaves the library: its file, and the ten lines of NumPy that run it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.learning import Policy
from mjxgrad.learning.networks import Network, Normaliser


@eqx.filter_jit
def _made(key):
    seen = 3 * jax.random.normal(key, (50, 6)) + jnp.arange(6.0)
    return Policy(Network.make((6, 32, 16, 3), key), Normaliser.make(6).with_more(seen))


@pytest.fixture
def policy(key):
    return _made(key)


def test_a_policy_that_is_loaded_is_the_saved_one_to_the_bit(policy, tmp_path):
    policy.save(tmp_path / "policy.npz")
    for one, other in zip(*map(jax.tree.leaves, (policy, Policy.load(tmp_path / "policy.npz"))), strict=True):
        np.testing.assert_array_equal(one, other)


def test_numpy_runs_a_saved_policy(policy, tmp_path):
    """The lines of HOWTO."""
    policy.save(tmp_path / "policy.npz")
    net = np.load(tmp_path / "policy.npz")

    def act(obs):
        x = (obs - net["mean"]) / net["scale"]
        for i in range(2):
            x = net[f"weight{i}"] @ x + net[f"bias{i}"]
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
            x = (x - x.mean()) / np.sqrt(x.var() + 1e-5) * net[f"gain{i}"] + net[f"offset{i}"]
        return np.tanh(net["weight2"] @ x + net["bias2"])

    for obs in np.random.default_rng(0).normal(size=(5, 6)):
        np.testing.assert_allclose(act(obs), policy(jnp.asarray(obs)), atol=1e-6)


def test_a_policy_is_shown_by_its_sizes_and_what_it_has_seen(policy):
    """Six numbers in, three actions out; in a trace what it has seen is not known, and a tree of axes is no policy."""
    assert repr(policy) == "Policy(6 → 32 → 16 → 3, 50 observations seen)"
    both = jax.tree.map(lambda x: jnp.stack([x, x]), policy)
    assert repr(both) == "Policy(6 → 32 → 16 → 3, 50 observations seen, 2 side by side)"
    told = []
    jax.eval_shape(lambda traced: told.append(repr(traced)), policy)
    assert told == ["Policy(6 → 32 → 16 → 3)"]
    assert "Network(" in repr(jax.tree.map(lambda _: 0, policy))


def test_several_policies_are_not_one_file(policy, tmp_path):
    both = jax.tree.map(lambda x: jnp.stack([x, x]), policy)
    with pytest.raises(ValueError, match="policy must be one, got several"):
        both.save(tmp_path / "policy.npz")
