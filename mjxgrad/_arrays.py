"""What is known of arrays while a program is traced, and roots whose derivatives exist where the usual ones have none."""

import collections
import functools
import hashlib
import operator
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_Function = TypeVar("_Function", bound=Callable)


def compiled(function: _Function) -> _Function:
    """Compile a function of arrays, or of trees with arrays, once for each shape and structure of them.

    Called with traced values it is part of a larger program and left to that, in which more of the values may be known. It must
    depend on its arguments alone: what it reads besides is read once.
    """
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return function(*args, **kwargs)
        # Whether a type is weak is part of a program: results that go in again would be compiled for a second time.
        strong = lambda x: x.astype(x.dtype) if getattr(x, "weak_type", False) else x  # noqa: E731
        return program(*jax.tree.map(strong, args), **jax.tree.map(strong, kwargs))

    return call  # pyright: ignore[reportReturnType]


_KEPT: collections.OrderedDict[Any, jax.stages.Compiled] = collections.OrderedDict()
_MOST_KEPT = 64


def compile_once(lowered: jax.stages.Lowered, options: dict | None = None) -> jax.stages.Compiled:
    """Compile a program, or return what was compiled of the same text: a function that was traced anew need not be.

    The text has every number in it that is no argument, but not what a callback calls.
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


def as_float(value: Any) -> Any:
    """Return numbers, integers too (10000 is a natural way to write a stiffness), as an array; None as it is."""
    return None if value is None else jnp.asarray(value, dtype=jnp.result_type(float))


def known(values: Any) -> np.ndarray | None:
    """Return numbers as they are; None for those that only the running program, or a derivative, knows."""
    return None if isinstance(values, jax.core.Tracer) else np.asarray(values)


def is_known(value: Any) -> bool:
    """Return whether this is an array that can be looked at.

    Trees of other things than numbers (axes of vmap, shapes) go through the same constructors.
    """
    return isinstance(value, jax.Array | np.ndarray) and not isinstance(value, jax.core.Tracer)


def is_known_to_be(number: float, values: Any, *, column: int | None = None) -> bool:
    """Return whether all numbers of an array, or of one of its columns, are known, and are this one."""
    found = known(values)
    return found is not None and bool(np.all((found if column is None else found[..., column]) == number))


def whole(name: str, value: Any, least: int | None = 1) -> int:
    """Return a count, refusing what is no whole number, too small, or known to the running program alone."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"{name} must be known before anything is compiled, got a traced value; make it static in jax.jit"
        )
    try:
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, got {value!r}") from None
    if least is not None and number < least:
        raise ValueError(f"{name} must be at least {least}, got {number}")
    return number


def form(value: Any) -> str:
    """Return the shape of numbers, or the type of what is none, as messages print it."""
    return f"shape {jnp.shape(value)}" if eqx.is_array_like(value) else type(value).__name__


def one_key(key: Any) -> None:
    """Refuse what is not a single random key."""
    dtype, shape = getattr(key, "dtype", None), jnp.shape(key)
    is_new = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not ((is_new and shape == ()) or (dtype == jnp.uint32 and shape == (2,))):
        given = f"an array of shape {shape}" if shape else repr(key)
        raise ValueError(f"key must be one of jax.random.key, got {given}; jax.vmap takes several")


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose derivative at zero is zero instead of infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm over the last axis, with derivative zero at the zero vector."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))
