"""Environments of MuJoCo Playground and brax, stepped by `mg.step`.

Both call `mjx.step`; here it is ours while their `reset` and `step` run, and theirs again after. Nothing else of them changes.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import mujoco.mjx

from mjxgrad._mjx import mjx
from mjxgrad.stepping import Gradient, Onset, Smoothing, check_gradient, step

Foreign = TypeVar("Foreign")
_LOCK = threading.RLock()


def load(
    name: str,
    config: Any = None,
    config_overrides: Mapping[str, Any] | None = None,
    *,
    gradient: Gradient = "discrete",
    onset: Onset | None = None,
    smoothing: Smoothing | None = None,
    iterations: int = 100,
) -> Any:
    """Load an environment of MuJoCo Playground, to be stepped by `mg.step`.

    It is their own object, fit for their wrappers and randomisers. Its motion is theirs with a solver that has converged, unless
    an onset or smoothing changes it.

    Args:
        name: as `registry.load` takes it, for instance "CartpoleSwingup".
        config: theirs; None is the default.
        config_overrides: by flattened name; `impl` is "jax", the implementation that has derivatives.
        gradient: see `mg.step`.
        onset: lets contacts begin within the step; `mg.Onset()` for learning by derivatives.
        smoothing: averages contacts.
        iterations: see `stepped_right`.

    Raises:
        ImportError: if playground is not installed.
        ValueError: if there is no such environment or gradient, or it does not go with onset or smoothing.
    """
    # Imported here: brax's environments need no playground.
    try:
        from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(f"{name} is MuJoCo Playground's, not installed: pip install 'mjxgrad[playground]'") from error
    overrides = {**(config_overrides or {}), "impl": "jax"}
    # A copy, for theirs is changed by the overrides.
    own = None if config is None else config.copy_and_resolve_references()
    environment = registry.load(name, own, overrides)
    return stepped_right(environment, gradient=gradient, onset=onset, smoothing=smoothing, iterations=iterations)


def stepped_right(
    environment: Foreign,
    *,
    gradient: Gradient = "discrete",
    onset: Onset | None = None,
    smoothing: Smoothing | None = None,
    iterations: int = 100,
) -> Foreign:
    """Have an object's `reset` and `step` run on `mg.step` wherever they call `mjx.step`.

    Args:
        environment: with such methods, of MJX's JAX implementation: one of playground's or of brax's backend "mjx", or one of
            your own. Only this object changes.
        gradient: see `mg.step`.
        onset: lets contacts begin within the step; `mg.Onset()` for learning by derivatives.
        smoothing: averages contacts.
        iterations: of the solver, if theirs are fewer; it stops at the model's tolerance. Many of theirs stop after 1 to 4, far
            from it where feet hit the ground: the motion is then not the model's, and a derivative of the solve not that of
            the motion.

    Returns:
        The same object.

    Raises:
        ValueError: if there is no such gradient, or it does not go with onset or smoothing.
    """
    check_gradient(gradient, onset, smoothing)
    by_ours = functools.partial(_step, iterations, gradient=gradient, onset=onset, smoothing=smoothing)
    # On the object, not in a wrapper: those who randomise models go to the innermost environment and call its step.
    for name in ("reset", "step"):
        setattr(environment, name, _within(getattr(environment, name), by_ours))
    return environment


def _step(iterations: int, model: mjx.Model, data: mjx.Data, **settings: Any) -> mjx.Data:
    most = max(iterations, model.opt.iterations)
    return step(model.replace(opt=model.opt.replace(iterations=most)), data, **settings)


def _within(method: Callable, by_ours: Callable[[mjx.Model, mjx.Data], mjx.Data]) -> Callable:
    @functools.wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        with _substituted(by_ours):
            return method(*args, **kwargs)

    return call


@contextlib.contextmanager
def _substituted(by_ours: Callable[[mjx.Model, mjx.Data], mjx.Data]) -> Iterator[None]:
    """Let `mjx.step` be ours within the block, in this thread."""
    # One thread at a time: two that took turns would put back each other's substitute.
    with _LOCK:
        original, thread = mujoco.mjx.step, threading.get_ident()

        def substitute(model: mjx.Model, data: mjx.Data) -> mjx.Data:
            return (by_ours if threading.get_ident() == thread else original)(model, data)

        mujoco.mjx.step = substitute
        try:
            yield
        finally:
            mujoco.mjx.step = original
