"""Known values of traced arrays, and checks of arguments."""

import contextlib
import inspect
import operator
from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

_MOST_SHOWN = 24  # numbers of a vector that are printed in full


def as_float(value: Any, name: str = "softness") -> Any:
    """Return numbers as an array of floats, also integers (10000 is a natural stiffness); None stays None."""
    return None if value is None else real(name, value, jnp.result_type(float))


def real(name: str, value: Any, dtype: Any = None) -> jax.Array:
    """Return real numbers as an array, known where they are given so; refuse text, objects and ragged lists."""
    is_traced = isinstance(value, jax.core.Tracer)
    try:
        kind = value.dtype if hasattr(value, "dtype") else np.asarray(value).dtype
    except jax.errors.TracerArrayConversionError:  # a list of traced numbers
        kind, is_traced = jnp.asarray(value).dtype, True
    except (TypeError, ValueError):
        kind = np.dtype(object)
    if not jnp.issubdtype(kind, jnp.number) or jnp.issubdtype(kind, jnp.complexfloating):
        got = "a random key" if jnp.issubdtype(kind, jax.dtypes.prng_key) else str(kind)
        if got == "object" or got.startswith("<U"):
            got = "an array of objects or text" if isinstance(value, np.ndarray) else type(value).__name__
        raise ValueError(f"{name} must be real numbers, got {got}")
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name} must be real numbers, got a masked array; fill it")
    with contextlib.nullcontext() if is_traced else jax.ensure_compile_time_eval():
        return jnp.asarray(value, dtype)


def known(values: Any) -> np.ndarray | None:
    """Return numbers with known values; None for values that only the running program, or a derivative, knows."""
    return None if isinstance(values, jax.core.Tracer) else np.asarray(values)


def is_known(value: Any) -> bool:
    """Return whether an argument is an array with known values; axes of vmap and shapes go through the same constructors."""
    return isinstance(value, jax.Array | np.ndarray) and not isinstance(value, jax.core.Tracer)


class Legible(eqx.Module):
    """A module that is printed with its numbers, where they are known, and not with their types."""

    def __repr__(self) -> str:
        return eqx.tree_pformat(jax.tree.map(_shown, self))


class _Verbatim(str):
    """Text that is printed without quotation marks."""

    __repr__ = str.__str__


def _shown(leaf: Any) -> Any:
    if not is_known(leaf) or leaf.ndim > 1 or not leaf.size or jnp.issubdtype(leaf.dtype, jax.dtypes.extended):
        return leaf
    if leaf.ndim:
        numbers = np.array2string(
            np.asarray(leaf), formatter={"float_kind": "{:.4g}".format}, threshold=_MOST_SHOWN, max_line_width=300
        )
        return _Verbatim(
            numbers if leaf.size <= _MOST_SHOWN else f"{jax.typeof(leaf).str_short(short_dtypes=True)} {numbers}"
        )
    return float(f"{leaf:.4g}") if jnp.issubdtype(leaf.dtype, np.floating) else leaf.item()


def is_known_to_be(number: float, values: Any, *, column: int | None = None) -> bool:
    """Return whether all numbers of an array, or one of its columns, are known to equal a value."""
    found = known(values)
    return found is not None and bool(np.all((found if column is None else found[..., column]) == number))


def whole(name: str, value: Any, least: int | None = 1) -> int:
    """Return a count; refuse fractions, True, counts that are too small or too large, and traced values."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(f"{name} must be known before anything is compiled, got a traced value; make it static")
    try:
        number = operator.index(value)
        assert not isinstance(value, bool | np.bool)
    except (TypeError, AssertionError):
        raise ValueError(f"{name} must be a whole number, got {value!r}") from None
    if least is not None and number < least:
        raise ValueError(f"{name} must be at least {least}, got {number}")
    if number >= 2**31:
        raise ValueError(f"{name} must be at most {2**31 - 1}, got {number}")
    return number


def sizes(name: str, value: Any, example: str) -> tuple[int, ...]:
    """Return counts; refuse anything but a tuple or list of them."""
    instance(name, value, tuple | list, f"a tuple of whole numbers, such as {example}")
    return tuple(whole(f"{name}[{i}]", one) for i, one in enumerate(value))


def positive(name: str, value: Any) -> None:
    """Refuse all but one finite number above 0."""
    found = np.asarray(real(name, value))
    if found.ndim or not 0 < found < np.inf:
        raise ValueError(f"{name} must be positive, got {value}")


def fraction(name: str, value: Any) -> None:
    """Refuse all but one number from 0 to 1."""
    found = np.asarray(real(name, value))
    if found.ndim or not 0 <= found <= 1:
        raise ValueError(f"{name} must be from 0 to 1, got {value}")


def one_of(name: str, value: Any, choices: Iterable[Any], remedy: str = "") -> None:
    """Refuse what is none of the choices."""
    choices = tuple(choices)
    if not any(value is one or (isinstance(value, str) and value == one) for one in choices):
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}{remedy}")


def instance(name: str, value: Any, kind: Any, wanted: str) -> None:
    """Refuse a value of another type."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be {wanted}, got {kind_of(value)}")


def function(name: str, value: Any, *arguments: str, is_needed: bool = False) -> None:
    """Refuse what is neither a function of these arguments nor, unless one is needed, None."""
    try:
        if value is not None or is_needed:
            inspect.signature(value).bind(*arguments)  # pyright: ignore[reportArgumentType]
    except TypeError as error:
        wanted = f"{name} must be a function of {' and '.join(arguments)}"
        raise ValueError(f"{wanted}, got {kind_of(value)}: {error}") from None
    except ValueError:  # a function of C without a signature
        return


@contextlib.contextmanager
def traceable(name: str) -> Iterator[None]:
    """Say what is wrong where a function of the user's leaves JAX, whose own words are of tracers."""
    errors = jax.errors
    kinds = (errors.ConcretizationTypeError, errors.TracerArrayConversionError, errors.TracerIntegerConversionError)
    try:
        yield
    except kinds as error:
        got = "NumPy, float(), int(), .item() or if on traced numbers"
        raise ValueError(f"{name} must compute with jax.numpy, got {got}; take jnp.where for if") from error


def takes(function: Any, name: str) -> bool:
    """Return whether a function has an argument of this name, one that is not bound yet."""
    try:
        found = inspect.signature(function).parameters.get(name)
    except (TypeError, ValueError):  # a function of C without a signature
        return False
    return found is not None


def kind_of(value: Any) -> str:
    """Return the type of anything, or the shape of an array, traced or not, for messages."""
    is_array = isinstance(value, jax.Array | np.ndarray)
    return f"an array of shape {value.shape}" if is_array else type(value).__name__


def form(value: Any) -> str:
    """Return the shape of numbers, or the type of anything else, for messages."""
    return f"shape {jnp.shape(value)}" if eqx.is_array_like(value) else type(value).__name__


def one_key(key: Any) -> None:
    """Refuse anything but a single random key."""
    dtype = getattr(key, "dtype", None)
    shape = () if key is None else jnp.shape(key)
    is_new = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not ((is_new and shape == ()) or (dtype == jnp.uint32 and shape == (2,))):
        given = f"an array of shape {shape}" if shape or eqx.is_array(key) else repr(key)
        raise ValueError(f"key must be one of jax.random.key, got {given}; jax.vmap takes several")


def with_derivative_of(value: Any, other: Any) -> Any:
    """Return a tree of arrays, exactly, with the derivative of another."""
    # Under `jax.vmap` an empty array loses the batch in one of a custom derivative's two functions.
    return jax.tree.map(lambda x, y: _with_derivative_of(x, y) if x.size else x, value, other)


@jax.custom_jvp
def _with_derivative_of(value, other):
    return value


@_with_derivative_of.defjvp
def _with_derivative_of_jvp(primals, tangents):
    return _with_derivative_of(*primals), tangents[1]
