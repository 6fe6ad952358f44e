"""Compiled programs, kept within a process and from one process to the next."""

import collections
import functools
import hashlib
import importlib.metadata
import os
import platform
import sys
import sysconfig
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import ArrayLike

from mjxgrad._interrupts import patiently

_Function = TypeVar("_Function", bound=Callable)
_INSTALLED = (*(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")), str(Path(__file__).parent))
_ATOMS = (type(None), bool, int, float, complex, str, bytes, np.dtype, np.generic, type(...), slice)


def is_traced(arguments: Any) -> bool:
    """Return whether a tree has traced values, as inside `jax.jit` and `jax.grad`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments))


Form = Callable[[Sequence[Any]], Any]
"""A tree without its arrays: a function from arrays to the tree, equal to itself alone."""
_FORMS: collections.OrderedDict[Any, tuple[Form, Any]] = collections.OrderedDict()
_MOST_KEPT = 64


def parted(tree: Any, *, trusts_hash: bool = False) -> tuple[list[ArrayLike], Form]:
    """Return the arrays of a tree, and its form, the same one for all trees of equal content beside arrays.

    A function defined anew, as in a Python loop, has equal content if its code and all that it refers to are equal. What may
    change unseen, such as a set, has a new form each time, or one form by its hash.
    """
    arrays, static = eqx.partition(tree, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    seen: dict[int, tuple[int, Any]] = {}  # kept with the form, so that its identities stay their own

    def own(leaves: Sequence[Any]) -> Any:
        return eqx.combine(jax.tree.unflatten(structure, leaves), static)

    places = tuple(eqx.is_array(x) for x in jax.tree.leaves(tree, is_leaf=lambda x: x is None))  # None is there, too
    try:
        key = places, _content(static, seen)
    except _UnknownError:
        key = (structure, *jax.tree.leaves(static)) if trusts_hash else own
    try:
        form, _ = _FORMS.setdefault(key, (own, seen))
    except TypeError:  # no hash
        return leaves, own
    if len(_FORMS) > _MOST_KEPT:
        _FORMS.popitem(last=False)
    return leaves, form


class _UnknownError(Exception):
    """Something may change without a trace."""


def _content(value: Any, seen: dict[int, tuple[int, Any]]) -> Any:
    """Return a key that is equal for equal content; what was seen is named by its number, also within itself."""
    if isinstance(value, _ATOMS):
        return type(value), repr(value)
    if id(value) in seen:
        return "seen", seen[id(value)][0]
    seen[id(value)] = len(seen), value
    of = lambda *parts: tuple(_content(part, seen) for part in parts)  # noqa: E731
    itself = "itself", id(value)
    if isinstance(value, np.ndarray | jax.Array):
        return digest(value)
    if isinstance(value, mujoco.MjModel):
        content = np.empty(mujoco.mj_sizeModel(value), np.uint8)
        mujoco.mj_saveModel(value, None, content)
        return digest(content)
    is_made_once = "<locals>" not in getattr(value, "__qualname__", "")
    if isinstance(value, types.ModuleType | type | types.FunctionType) and is_made_once and _is_installed(value):
        return itself
    if isinstance(value, types.FunctionType):
        outside = {} if _is_installed(value) else _outside(value.__globals__, _names(value.__code__), [])
        try:
            cells = [cell.cell_contents for cell in value.__closure__ or ()]
        except ValueError:
            raise _UnknownError from None
        return value.__code__, *of(value.__defaults__, value.__kwdefaults__, vars(value), cells, outside)
    if isinstance(value, types.MethodType):
        return of(value.__func__, value.__self__)
    if isinstance(value, functools.partial):
        return type(value), *of(value.func, value.args, value.keywords)
    if isinstance(value, tuple | list):
        return type(value), *of(*value)
    if isinstance(value, set | frozenset):
        return type(value), frozenset(of(*value))
    if isinstance(value, dict | types.MappingProxyType):
        return type(value), *of(*value, *value.values())
    if isinstance(value, type):  # the user's, with the functions of its methods and properties
        is_own = lambda k, x: not k.startswith(("__", "_abc")) or isinstance(x, types.FunctionType)  # noqa: E731
        members = [x for k, x in vars(value).items() if is_own(k, x)]
        inner = [getattr(x, "method", getattr(x, "fget", getattr(x, "__func__", x))) for x in members]
        return itself, *of(value.__bases__, inner)
    if hasattr(value, "__wrapped__"):  # a compiled function
        return itself, *(() if _is_installed(value) else of(value.__wrapped__))
    state = getattr(value, "__dict__", None)
    if state or (state is not None and not _is_installed(type(value))):
        return of(type(value), state)
    if isinstance(value, np.ufunc) or isinstance(getattr(value, "__self__", None), types.ModuleType):
        return itself
    if type(value).__hash__ in (None, object.__hash__):
        raise _UnknownError
    return type(value), value


def _names(code: types.CodeType) -> set[str]:
    """Return the names that a function and those within it take from elsewhere."""
    return set(code.co_names).union(*(_names(part) for part in code.co_consts if isinstance(part, types.CodeType)))


def _outside(space: Mapping[str, Any], names: set[str], within: list[Any]) -> dict[str, Any]:
    """Return what names mean in a module, and in modules of the user that they name there."""
    found = {name: space[name] for name in names if name in space and not any(space[name] is one for one in within)}
    for name, value in found.items():
        if isinstance(value, types.ModuleType) and not _is_installed(value):
            found[name] = _outside(vars(value), names, [*within, value])
    return found


def digest(value: Any) -> tuple:
    """Return the type and shape of an array, and a hash of its numbers."""
    if isinstance(value, jax.core.Tracer) or value.dtype == object:
        raise _UnknownError
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return "key", str(value.dtype), *digest(jax.random.key_data(value))
    content = hashlib.sha256(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data).hexdigest()
    return str(value.dtype), value.shape, getattr(value, "weak_type", False), content


def _is_installed(value: Any) -> bool:
    """Return whether something is of an installed library, which does not change while a program runs."""
    name = value.__name__ if isinstance(value, types.ModuleType) else value.__module__
    path = getattr(sys.modules.get(name), "__file__", None) or ""
    return name in sys.builtin_module_names or path.startswith(_INSTALLED)


def compiled(function: _Function) -> _Function:
    """Compile a function of arrays, or trees with arrays, once per shape and content of all else; see `parted`.

    Called with traced values it becomes part of the outer program, where more values may be known. The function must depend
    on its arguments alone.
    """

    @eqx.filter_jit
    def program(form: Form, leaves: list[ArrayLike]) -> Any:
        args, kwargs = form(leaves)
        return function(*args, **kwargs)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        # A setting may come as a number of numpy's; only a known one can decide a shape.
        is_count = lambda x: eqx.is_array(x) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.integer)  # noqa: E731
        kwargs = {k: int(x) if is_count(x) and not is_traced(x) else x for k, x in kwargs.items()}
        if is_traced((args, kwargs)):
            return function(*args, **kwargs)
        leaves, form = parted((args, kwargs), trusts_hash=True)
        # Weak types belong to a program's signature: feeding results back would compile it a second time.
        return program(form, [x.astype(x.dtype) if getattr(x, "weak_type", False) else x for x in leaves])

    return call  # pyright: ignore[reportReturnType]


_KEPT: collections.OrderedDict[Any, jax.stages.Compiled] = collections.OrderedDict()


def compile_once(lowered: jax.stages.Lowered, options: dict | None = None) -> jax.stages.Compiled:
    """Compile a program, or return the compiled program of equal text, so that tracing a function anew costs no compilation.

    The text contains all constants, but not the bodies of callbacks.
    """
    text, shapes = lowered.as_text(), str(jax.tree.leaves(lowered.args_info))
    key = (hashlib.sha256(text.encode()).digest(), lowered.in_tree, lowered.out_tree, shapes)
    program = _KEPT.pop(key, None) or patiently(lambda: lowered.compile(compiler_options=options))
    if "callback" not in text:
        _KEPT[key] = program  # the latest
        if len(_KEPT) > _MOST_KEPT:
            _KEPT.popitem(last=False)
    return program


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
