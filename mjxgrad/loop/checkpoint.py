"""Checkpoints: a run on disk, complete or not at all."""

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjxgrad._text import write

FORMAT = 3
_PARTS = {
    "program": "the code of environment, objective, estimator, optimiser, method or versions of the libraries",
    "arrays": "arrays in environment, objective or method",
    "start": "params or key",
}


def save(path: Path, tree: PyTree, fingerprint: dict[str, Any]) -> None:
    """Write a pytree of arrays atomically: an interruption leaves the former file intact."""
    leaves = {f"leaf{i}": _as_numpy(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
    header = json.dumps({"format": FORMAT, **fingerprint}).encode()
    with io.BytesIO() as file:
        np.savez(file, allow_pickle=False, header=np.frombuffer(header, np.uint8), **leaves)
        write(path, file.getvalue())


def load(path: Path, like: PyTree, fingerprint: dict[str, Any]) -> PyTree:
    """Return the pytree that `save` wrote, with the structure and types of `like` and its own shapes.

    Raises:
        ValueError: if the file is damaged, or its fingerprint differs; the message names the difference.
    """
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no archive of arrays")
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(archive["header"].tobytes())
            leaves = [archive[f"leaf{i}"] for i in range(len(archive.files) - 1)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"checkpoint must be a file that a run has saved, got {path}, which cannot be read ({error}); "
            "delete it to begin anew"
        ) from error
    expected = {"format": FORMAT, **fingerprint}
    differing = {name: value for name, value in expected.items() if header.get(name) != value}
    if differing:
        changes = [_PARTS.get(name, f"{name} was {header.get(name)} and is {here}") for name, here in differing.items()]
        raise ValueError(
            f"checkpoint must be of the same run, got {path} of one with other settings: {', '.join(changes)}; "
            "use the settings of that run, or another path"
        )
    wanted = jax.tree.leaves(like)
    return jax.tree.unflatten(jax.tree.structure(like), [_restored(x, y) for x, y in zip(leaves, wanted, strict=True)])


def digest(tree: PyTree) -> str:
    """Return a short hash of the content of arrays."""
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = _as_numpy(leaf)
        sha.update(f"{array.dtype}{array.shape}".encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()[:16]


def _as_numpy(leaf: Any) -> np.ndarray:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def _restored(saved: np.ndarray, like: Any) -> Any:
    if isinstance(like, jax.Array) and jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(saved), impl=jax.random.key_impl(like))
    if saved.dtype.kind == "V":  # NumPy's format has no name for bfloat16 and its like
        saved = saved.view(np.asarray(like).dtype)
    return saved if isinstance(like, np.ndarray) else jnp.asarray(saved)
