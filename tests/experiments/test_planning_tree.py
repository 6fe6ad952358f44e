"""A tree over reachable sets: its metric against dense algebra, and the ways that it finds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.planning.tree import Sampling, path, reach, search
from mjxgrad.planning import Exact, FunctionSystem, LinearModel, Sampled

GAP = 0.3


def pushed(state, control):
    """A finger and a block on a rail; the block gives way to the finger, and does not come along."""
    finger = state[0] + control[0]
    return jnp.stack([finger, jnp.maximum(state[1], finger)])


def test_the_distance_from_a_reach_is_that_of_its_inverse_covariance():
    rng = np.random.default_rng(1)
    J, radius, resolution = rng.normal(size=(3, 2)), np.array([0.5, 2.0]), np.array([0.1, 0.2, 0.3])
    none = jnp.zeros((3, 0))
    model = LinearModel(none, jnp.array(J), jnp.zeros(3), none, jnp.zeros((3, 2)), jnp.zeros(3), jnp.ones(()))
    weights = jnp.stack([jnp.array(resolution**-2.0) * jnp.array([1, 1, 0]), jnp.array(resolution**-2.0)])
    away, system = rng.normal(size=3), FunctionSystem(pushed, 3, 2)
    for kind, counts in ((0, [0, 1]), (1, [0, 1, 2])):
        covariance = (J * radius**2 @ J.T + np.diag(resolution**2))[np.ix_(counts, counts)]
        expected = away[counts] @ np.linalg.solve(covariance, away[counts])
        found, control = reach(model, jnp.array(radius), weights).distance(
            system, jnp.array(away), weights, jnp.array(kind)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-10)
        # The ridge solution of the same problem, in units of the reach.
        scaled = (J * radius / resolution[:, None])[counts]
        ridge = np.linalg.solve(scaled.T @ scaled + np.eye(2), scaled.T @ (away / resolution)[counts])
        np.testing.assert_allclose(control, ridge, rtol=1e-10)


@pytest.fixture(scope="module")
def searched():
    """The search for a way of the block from 0 to 1; the finger starts short of it."""
    sampling = Sampling(-2 * jnp.ones(2), 2 * jnp.ones(2), 0.01 * jnp.ones(2), batch=4, max_extension=4)

    @eqx.filter_jit
    def run():
        return search(
            FunctionSystem(pushed, 2, 1),
            jnp.array([-GAP, 0.0]),
            jnp.array([0.0, 1.0]),
            np.array([np.inf, 0.02]),
            jax.random.key(0),
            smoother=Sampled(0.2, 0.02, 50, "first"),
            sampling=sampling,
            lower=-0.1,
            upper=0.1,
            capacity=1000,
            max_turns=200,
        )

    return run()


def test_a_tree_by_smoothed_reach_finds_a_way_that_is_a_rollout(searched):
    assert searched.is_solved
    way = path(searched)
    np.testing.assert_array_equal(way.states[0], [-GAP, 0.0])
    np.testing.assert_allclose(way.states[-1, 1], 1.0, atol=0.02)
    assert np.all(np.abs(way.controls) <= 0.1 + 1e-12)
    for before, control, after in zip(way.states, way.controls, way.states[1:], strict=False):
        np.testing.assert_allclose(pushed(before, control), after, atol=1e-12)


def test_a_tree_knows_the_parent_of_every_node(searched):
    nodes = jax.tree.map(np.asarray, searched.nodes)
    for i in range(1, int(nodes.size)):
        assert 0 <= nodes.parents[i] < i
        np.testing.assert_allclose(
            pushed(nodes.states[nodes.parents[i]], nodes.controls[i]), nodes.states[i], atol=1e-12
        )


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"tolerance": np.full(2, np.inf)}, "tolerance must be finite for at least one position"),
        ({"tolerance": np.zeros(2)}, "tolerance must be positive"),
        ({"upper": np.inf}, "limits of the controls must be finite"),
        ({"capacity": 10}, "capacity must be at least 129"),
        ({"sampling": Sampling(-jnp.ones(3), jnp.ones(3), jnp.ones(3))}, r"sampling.lower must have shape \(2,\)"),
    ],
)
def test_a_search_that_cannot_be_is_refused_in_a_sentence(settings, sentence):
    sampling = Sampling(-jnp.ones(2), jnp.ones(2), jnp.ones(2))
    settings = {"tolerance": np.ones(2), "lower": -1.0, "upper": 1.0, "sampling": sampling} | settings
    with pytest.raises(ValueError, match=sentence):
        search(
            FunctionSystem(pushed, 2, 1), jnp.zeros(2), jnp.ones(2), key=jax.random.key(0), smoother=Exact(), **settings
        )


def test_to_search_again_compiles_nothing(compilations):
    """From elsewhere, with other noise, resolution and limits."""
    for i in range(3):
        before = len(compilations)
        search(
            FunctionSystem(pushed, 2, 1),
            jnp.array([-GAP - i, 0.0]),
            jnp.array([0.0, 1.0 + i]),
            np.array([np.inf, 0.1]),
            jax.random.key(i),
            smoother=Sampled(0.1 + i, 0.1, num_samples=4, order="first"),
            sampling=Sampling(-jnp.ones(2), jnp.ones(2), 0.1 * (i + 1) * jnp.ones(2), batch=2, max_extension=2),
            lower=-1.0 - i,
            upper=1.0,
            capacity=20,
            max_turns=2,
        )
        assert i == 0 or len(compilations) == before
