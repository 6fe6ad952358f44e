"""What makes a gradient unsound."""

import jax.numpy as jnp

from experiments.problems.soundness import soundness


def test_a_gradient_is_unsound_for_each_of_its_reasons():
    good = {"a": jnp.ones(3), "b": jnp.array(2.0)}
    assert bool(soundness(good).is_sound)
    assert not bool(soundness(good, diverged=True).is_sound)
    assert not bool(soundness(good | {"b": jnp.array(jnp.nan)}).is_sound)
    bounded = soundness(good | {"b": jnp.array(-1e5)}, bound=1e4)
    assert bool(bounded.explodes)
    assert not bool(bounded.is_sound)
    assert float(bounded.largest) == 1e5
