"""Environments of MuJoCo Playground and brax, stepped by `mg.step`.

Both call `mjx.step`. It is replaced by `mg.step` while their `reset` and `step` run, and restored after. Nothing else changes.
"""

import functools
import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import mujoco.mjx

from mjxgrad._mjx import mjx
from mjxgrad.stepping import Contact, Discrete, check_contact, step

Foreign = TypeVar("Foreign")
_LOCK = threading.RLock()


def load(
    name: str,
    config_overrides: Mapping[str, Any] | None = None,
    *,
    contact: Contact = Discrete(),
    iterations: int = 100,
) -> Any:
    """Load an environment of MuJoCo Playground, to be stepped by `mg.step`.

    The object is Playground's own and works with its wrappers and randomisers. Its motion is Playground's with a converged
    solver, unless `contact` changes it. The name, such as "CartpoleSwingup", is that of `registry.load`. The overrides are
    values by flattened name; `impl` is always "jax", which has derivatives. All else is as in `stepped_right`.

    Raises:
        ImportError: if playground is not installed.
        ValueError: if there is no such environment, or as in `stepped_right`.
    """
    # Imported here: brax's environments need no playground.
    try:
        from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(f"{name} is MuJoCo Playground's, not installed: pip install 'mjxgrad[playground]'") from error
    overrides = {**(config_overrides or {}), "impl": "jax"}
    return stepped_right(registry.load(name, None, overrides), contact=contact, iterations=iterations)


def stepped_right(environment: Foreign, *, contact: Contact = Discrete(), iterations: int = 100) -> Foreign:
    """Replace `mjx.step` by `mg.step` in an object's `reset` and `step`, and return the object.

    Args:
        environment: an object with these methods on MJX's JAX implementation: from Playground, from brax's backend "mjx", or
            your own. Only this object changes.
        contact: how contact is stepped, see `mg.step`.
        iterations: least limit on the solver's iterations; it stops at the model's tolerance. Many of their models stop after
            1 to 4, where the solve's derivative is not yet that of the motion.

    Raises:
        ValueError: if contact does not suit `mg.step`.
    """
    check_contact(contact)

    def own_step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
        most = max(iterations, model.opt.iterations)
        return step(model.replace(opt=model.opt.replace(iterations=most)), data, contact=contact)

    # On the object, not in a wrapper: randomisers of models call the step of the innermost environment.
    for name in ("reset", "step"):
        setattr(environment, name, _within(getattr(environment, name), own_step))
    return environment


def _within(method: Callable, own_step: Callable[[mjx.Model, mjx.Data], mjx.Data]) -> Callable:
    """Return a method during which `mjx.step` is replaced, in its thread."""

    @functools.wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        # One thread at a time: two interleaved threads would restore each other's substitute.
        with _LOCK:
            original, thread = mujoco.mjx.step, threading.get_ident()
            mujoco.mjx.step = lambda *given: (own_step if threading.get_ident() == thread else original)(*given)
            try:
                return method(*args, **kwargs)
            finally:
                mujoco.mjx.step = original

    return call
