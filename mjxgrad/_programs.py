"""Compiled programs, kept within a process and from one process to the next."""

import collections
import functools
import hashlib
import importlib.metadata
import os
import platform
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

_Function = TypeVar("_Function", bound=Callable)


def is_traced(arguments: Any) -> bool:
    """Return whether a tree has traced values, as inside `jax.jit` and `jax.grad`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments))


def compiled(function: _Function) -> _Function:
    """Compile a function of arrays, or trees with arrays, once per shape and structure.

    Called with traced values it becomes part of the outer program, where more values may be known. The function must depend
    on its arguments alone: other variables are read only once. Where an argument cannot be told from others, since it has no
    hash, each call is on its own.
    """
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        # A setting may come as a number of numpy's; only a known one can decide a shape.
        is_count = lambda x: eqx.is_array(x) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.integer)  # noqa: E731
        kwargs = {k: int(x) if is_count(x) and not is_traced(x) else x for k, x in kwargs.items()}
        if is_traced((args, kwargs)) or not _is_hashable((args, kwargs)):
            return function(*args, **kwargs)
        # Weak types belong to a program's signature: feeding results back would compile it a second time.
        strong = lambda x: x.astype(x.dtype) if getattr(x, "weak_type", False) else x  # noqa: E731
        return program(*jax.tree.map(strong, args), **jax.tree.map(strong, kwargs))

    return call  # pyright: ignore[reportReturnType]


def _is_hashable(arguments: Any) -> bool:
    leaves, structure = jax.tree.flatten(arguments)
    try:
        hash((structure, tuple(leaf for leaf in leaves if not eqx.is_array(leaf))))
    except TypeError:
        return False
    return True


_KEPT: collections.OrderedDict[Any, jax.stages.Compiled] = collections.OrderedDict()
_MOST_KEPT = 64


def compile_once(lowered: jax.stages.Lowered, options: dict | None = None) -> jax.stages.Compiled:
    """Compile a program, or return the compiled program of equal text, so that tracing a function anew costs no compilation.

    The text contains all constants, but not the bodies of callbacks.
    """
    text = lowered.as_text()
    if "callback" in text:
        return lowered.compile(compiler_options=options)
    shapes = str(jax.tree.leaves(lowered.args_info))
    key = (hashlib.sha256(text.encode()).digest(), lowered.in_tree, lowered.out_tree, shapes)
    if key not in _KEPT:
        _KEPT[key] = lowered.compile(compiler_options=options)
    _KEPT.move_to_end(key)
    if len(_KEPT) > _MOST_KEPT:
        _KEPT.popitem(last=False)
    return _KEPT[key]


def keep_compiled() -> Path | None:
    """Keep compiled programs in the user's cache folder, for the next process. Call it before any computation.

    It sets JAX's global `jax_compilation_cache_dir`, unless it is set already. Programs hold for one processor and one
    jaxlib, so each combination has its own folder. Nothing removes old programs; the folder may be deleted at any time.

    Returns:
        The folder in use; None if it cannot be written, and nothing is kept.
    """
    if present := jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return Path(present)
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute()
        place = caches / "mjxgrad" / f"jaxlib-{importlib.metadata.version('jaxlib')}-{_processor()}"
        place.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # read-only, or no home directory
        return None
    if not os.access(place, os.W_OK):
        return None
    found = {"compilation_cache_dir": str(place), "persistent_cache_min_compile_time_secs": 0.0}
    for name, value in (found | {"persistent_cache_min_entry_size_bytes": -1}).items():
        jax.config.update(f"jax_{name}", value)
    warnings.showwarning = functools.partial(_show, warnings.showwarning, place, [])
    return place


def _show(show: Callable[..., None], place: Path, told: list[Any], message: Any, *args: Any, **kwargs: Any) -> None:
    """Show a warning, but JAX's many warnings about unreadable or unwritable programs only once."""
    if "persistent compilation cache" in str(message):
        told.append(message)
        message = UserWarning(f"programs in {place} cannot be read or written and are compiled again; delete it")
    if len(told) < 2 or not str(message).startswith("programs in"):
        show(message, *args, **kwargs)


def _processor() -> str:
    """Return a short name of the processor with its features, for which programs are compiled."""
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.is_file() else [platform.processor()]
    wanted = ("model name", "flags", "Features", "CPU part")
    kinds = sorted({line for line in lines if line.startswith(wanted)} or lines[:1])
    return f"{platform.machine()}-{hashlib.sha256(''.join(kinds).encode()).hexdigest()[:8]}"
