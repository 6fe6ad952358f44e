"""Compiled programs kept for the next process; in processes of their own, as JAX reads its settings once."""

import os
import textwrap

import jax.numpy as jnp
import optax
import pytest

from mjxgrad._programs import parted
from tests.processes import run_python

_KEPT = """
    import jax
    import jax.numpy as jnp

    import mjxgrad as mg

    hits = []
    jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("/cache_hits") else None)
    print(mg.keep_compiled())
    for slope in (2.0, 3.0):
        jax.jit(lambda x, slope=slope: jnp.sin(slope * x))(jnp.ones(3)).block_until_ready()
    print(len(hits))
"""


def _run_keeping(caches):
    printed, said = run_python("-c", textwrap.dedent(_KEPT), XDG_CACHE_HOME=str(caches))
    return *printed.split(), said


def test_programs_are_kept_for_the_next_process(tmp_path, monkeypatch):
    """Its programs are read, not compiled; damaged ones are said in one line, and where nothing can be written nothing is."""
    for name in [name for name in os.environ if name.startswith("JAX_")]:
        monkeypatch.delenv(name)
    folder, none, _ = _run_keeping(tmp_path)
    assert folder.startswith(str(tmp_path / "mjxgrad" / "jaxlib-"))
    assert none == "0"
    _, hits, said = _run_keeping(tmp_path)
    assert (int(hits) >= 3, said) == (True, "")
    for entry in (tmp_path / "mjxgrad").rglob("*-cache"):
        entry.write_bytes(b"damaged")
    _, hits, said = _run_keeping(tmp_path)
    assert hits == "0"
    assert said.count("UserWarning") == said.count(f"programs in {folder} cannot be read") == 1
    (tmp_path / "file").touch()
    assert _run_keeping(tmp_path / "file") == ("None", "0", "")


WIDTH, LIST = 1.0, [1.0]


def test_functions_of_equal_content_share_a_program():
    """Made anew they are alike; another number, of a closure, of this module, in a list or an object, makes another."""
    scaled = lambda factor: lambda x: factor * x  # noqa: E731
    wide, listed = (lambda x: WIDTH * x), (lambda x: LIST[0] * x)
    is_same = lambda one, other: parted(one)[1] is parted(other)[1]  # noqa: E731
    assert is_same(scaled(1.0), scaled(1.0))
    assert not is_same(scaled(1.0), scaled(2.0))
    assert not is_same(scaled(1.0), scaled(1))
    assert is_same(scaled(jnp.ones(3)), scaled(jnp.ones(3)))
    assert not is_same(scaled(jnp.ones(3)), scaled(jnp.zeros(3)))
    # None where an array was is another form.
    assert not is_same({"a": jnp.ones(2), "b": None}, {"a": None, "b": jnp.ones(2)})
    assert not is_same([jnp.ones(2)], [None])
    assert is_same(optax.adam(1e-2), optax.adam(1e-2))
    assert not is_same(optax.adam(1e-2), optax.adam(1e-3))
    for function, change in ((wide, {"WIDTH": 2.0}), (listed, {"LIST": [2.0]})):
        before = parted(function)[1]
        assert parted(function)[1] is before
        with pytest.MonkeyPatch.context() as patch:
            for name, value in change.items():
                patch.setitem(globals(), name, value)
            assert parted(function)[1] is not before


def test_what_a_function_carries_and_refers_to_belongs_to_its_content():
    """Its own attributes, a set, and an operator of a class."""

    class Factor:
        def __mul__(self, x):
            return x

    factor, chosen = Factor(), {"one"}
    by_set, by_operator = (lambda x: x * ("two" in chosen)), (lambda x: factor * x)

    def by_attribute(x):
        return x * by_attribute.gain  # pyright: ignore[reportFunctionMemberAccess]

    by_attribute.gain = 1.0
    before = [parted(one, trusts_hash=True)[1] for one in (by_set, by_operator, by_attribute)]
    assert before == [parted(one, trusts_hash=True)[1] for one in (by_set, by_operator, by_attribute)]
    chosen.add("two")
    by_attribute.gain = 2.0
    Factor.__mul__ = lambda self, x: 2 * x
    after = [parted(one, trusts_hash=True)[1] for one in (by_set, by_operator, by_attribute)]
    assert not set(before) & set(after)
