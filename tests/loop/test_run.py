"""The loop repeats any method: one with a start and a step alone has seeds, logs and checkpoints."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.loop import Method, run, side_by_side


class Walk(Method):
    """A random walk whose carry is a dict; it is over beyond a wall."""

    length: jax.Array
    wall: float = np.inf

    def init(self, start):
        return {"place": jnp.zeros(()), "key": start}

    def step(self, carry, index):
        place = carry["place"] + self.length * jax.random.normal(jax.random.fold_in(carry["key"], index))
        return carry | {"place": place}, {"place": place, "number": index}

    def is_over(self, carry):
        return carry["place"] > self.wall


def test_steps_are_those_taken_by_hand_whatever_the_segment(key):
    draws = [0.5 * jax.random.normal(jax.random.fold_in(key, i)) for i in range(7)]
    for segment in (3, 7, 20):
        progress = run(Walk(jnp.array(0.5)), key, num_steps=7, segment=segment)
        np.testing.assert_allclose(progress.found["place"], np.cumsum(draws), rtol=1e-12)
        np.testing.assert_array_equal(progress.found["number"], np.arange(7))


def test_a_log_is_told_the_means_of_a_segment(key):
    told = []
    progress = run(Walk(jnp.array(0.5)), key, num_steps=5, segment=3, log=lambda *arguments: told.append(arguments))
    assert [step for step, _ in told] == [3, 5]
    assert told[1][1]["place"] == pytest.approx(progress.found["place"][3:].mean())
    assert told[1][1]["number"] == 3.5


def test_a_resumed_run_says_how_many_steps_are_left(key, tmp_path, monkeypatch, capsys):
    """Four of ten are done, and one more when it is told."""
    for name in ("_LONG", "_PULSE"):
        monkeypatch.setattr(sys.modules["mjxgrad.loop.run"], name, 0.0)  # not the function of this name
    for num_steps, said in ((4, "s for 4; Ctrl-C"), (10, "s for the 5 left of 10; Ctrl-C")):
        run(Walk(jnp.array(0.5)), key, num_steps=num_steps, segment=2, checkpoint=tmp_path / "walk.npz")
        assert said in capsys.readouterr().err


def test_what_is_over_takes_no_further_step(key):
    whole = run(Walk(jnp.array(0.5)), key, num_steps=40, segment=8).found["place"]
    wall = float(np.sort(whole)[-5])
    progress = run(Walk(jnp.array(0.5), wall), key, num_steps=40, segment=8)
    assert progress.num_steps == np.argmax(whole > wall) + 1


def test_methods_and_starts_side_by_side_are_as_each_alone(key):
    """Of two lengths with three seeds each, the last seed of the second."""
    keys = jax.random.split(key, 3)
    both, axes = side_by_side([Walk(jnp.array(0.5)), Walk(jnp.array(2.0))])
    found = run(both, jnp.stack([keys, keys]), num_steps=4, segment=4, over=[axes, None]).found
    alone = run(Walk(jnp.array(2.0)), keys[2], num_steps=4, segment=4).found
    assert found["place"].shape == (4, 2, 3)
    np.testing.assert_allclose(found["place"][:, 1, 2], alone["place"], rtol=1e-12)
    with pytest.raises(ValueError, match="must differ in numbers alone"):
        side_by_side([Walk(jnp.array(0.5)), Walk(jnp.array(0.5), 3.0)])


def test_other_numbers_compile_nothing(key, compilations):
    run(Walk(jnp.array(0.5)), key, num_steps=4, segment=2)
    before = len(compilations)
    run(Walk(jnp.array(0.7)), key, num_steps=4, segment=2)
    assert len(compilations) == before


def test_a_checkpoint_of_another_step_or_other_numbers_is_refused(key, tmp_path):
    """The class has the same name; what it does has changed."""
    settings = {"num_steps": 4, "segment": 2, "checkpoint": tmp_path / "run"}
    done = run(Walk(jnp.array(0.5)), key, **settings)
    again = run(Walk(jnp.array(0.5)), key, **settings)
    assert eqx.tree_equal(again.found, done.found)
    with pytest.raises(ValueError, match="arrays in environment"):
        run(Walk(jnp.array(0.7)), key, **settings)
    other = type("Walk", (Walk,), {"step": lambda self, carry, index: Walk.step(self, carry, index + 1)})
    with pytest.raises(ValueError, match="or the code, of environment"):
        run(other(jnp.array(0.5)), key, **settings)
