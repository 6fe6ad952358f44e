"""Compiled programs kept for the next process; in processes of their own, as JAX reads its settings once."""

import os
import textwrap

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
