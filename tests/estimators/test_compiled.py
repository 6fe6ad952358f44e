"""Estimators are compiled once per form of their arguments, however they are called."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad import estimators
from tests.estimators import textbook

ALL = [name for name in estimators.__all__ if name[0].islower() and name != "rules"]


@pytest.mark.parametrize("name", ALL)
def test_later_calls_trace_nothing(key, name):
    traced = []

    class Counted(textbook.LinearSystem):
        def run(self, *args, **kwargs):
            traced.append(1)
            return super().run(*args, **kwargs)

    estimate, task = getattr(estimators, name), Counted()
    found = []
    for i, stddev in enumerate((0.3, 0.3, 0.2)):
        # Another width, another point and another key, all of the same form, in an objective made anew.
        objective = mg.open_loop(task, jnp.asarray(stddev))
        found.append(estimate(objective, jnp.full(4, 0.1 * i), jax.random.fold_in(key, i), num_samples=8))
        if i == 0:
            first = len(traced)
    assert first > 0
    assert len(traced) == first
    values = [np.asarray(jax.tree.leaves(one)[0]) for one in found]
    assert not np.allclose(values[0], values[1])


def test_a_compiled_estimate_is_that_of_an_outer_program(key):
    objective, at = mg.open_loop(textbook.LinearSystem(), 0.3), jnp.full(4, 0.2)
    own = estimators.alpha_order(objective, at, key, num_samples=16)
    outer = jax.jit(lambda x, k: estimators.alpha_order(objective, x, k, num_samples=16))(at, key)
    np.testing.assert_allclose(own.value, outer.value, rtol=1e-12)


def test_a_cost_without_a_hash_is_estimated_too(key):
    @dataclasses.dataclass
    class Cost:
        scale: float

        def __call__(self, x):
            return self.scale * (x**2).sum()

    found = estimators.first_order(mg.parameter_noise(Cost(1.0), 0.1), jnp.ones(2), key, num_samples=8).value
    twice = estimators.first_order(mg.parameter_noise(Cost(2.0), 0.1), jnp.ones(2), key, num_samples=8).value
    np.testing.assert_allclose(twice, 2 * found)
