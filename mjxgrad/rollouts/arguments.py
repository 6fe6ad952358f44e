"""Checks of a rollout's arguments."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from mjxgrad._arrays import instance, known, real, whole
from mjxgrad.engines import Policy, State
from mjxgrad.engines.layout import INPUTS
from mjxgrad.engines.state import check_scene
from mjxgrad.scene import Scene


def sequence_of(
    controls: ArrayLike | Policy | None, noise: ArrayLike | None, horizon: int | None, num_controls: int
) -> tuple[Array | None, int]:
    """Return the controls if they are a sequence, and the number of steps; refuse contradicting arguments."""
    given = {"controls": None if callable(controls) else controls, "noise": noise}
    given = {name: real(name, value) for name, value in given.items() if value is not None}
    lengths = {name: len(value) for name, value in given.items() if value.ndim}
    if horizon is not None:
        lengths["horizon"] = whole("horizon", horizon)
    if not lengths:
        raise ValueError("horizon must be given where neither controls nor noise give it, got None")
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"controls, noise and horizon must agree on the number of steps, got {told}")
    horizon = next(iter(lengths.values()))
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    for name, value in given.items():
        if jnp.shape(value) != (horizon, num_controls):
            meaning = "one row per step and one column per actuator"
            is_turned = jnp.ndim(value) == 2 and jnp.shape(value)[0] == num_controls > 1
            wanted = (len(value[0]) if is_turned else horizon, num_controls)
            hint = "; transpose it" * is_turned
            raise ValueError(f"{name} must have shape {wanted}, {meaning}, got {jnp.shape(value)}{hint}")
        numbers = known(value)  # not jnp, whose operations are traced inside jit even on known values
        if numbers is not None and not np.isfinite(numbers).all():
            row, column = np.argwhere(~np.isfinite(numbers))[0]
            raise ValueError(f"{name} must be finite, got {numbers[row, column]} in step {row} for actuator {column}")
    return given.get("controls"), horizon


def check_start(scene: Any, state: Any) -> None:
    """Refuse what is no scene or no state, a state of another scene, or several states at once."""
    check_scene(scene)
    instance("state", state, State, "of mg.initial_state, or the end of a rollout")
    for name, size in (("qpos", scene.model.nq), ("qvel", scene.model.nv), ("act", scene.model.na)):
        if (shape := jnp.shape(getattr(state, name))) != (size,):
            remedy = "map over batches with jax.vmap"
            raise ValueError(f"state.{name} must have shape ({size},) in this scene, got {shape}: {remedy}")


def applied(scene: Scene, inputs: Mapping[str, ArrayLike] | None, horizon: int) -> dict[str, Array]:
    """Return the further inputs of each step; refuse unknown ones."""
    found = {}
    for name, value in ({} if inputs is None else inputs).items():
        if name not in INPUTS[1:]:
            raise ValueError(f"inputs must be among {', '.join(INPUTS[1:])}, got {name!r}")
        shape = (horizon, *getattr(scene.data, name).shape)
        if np.shape(value) != shape:
            raise ValueError(f"inputs[{name!r}] must have shape {shape}, one row per step, got {np.shape(value)}")
        numbers = known(value)
        if numbers is not None and not np.isfinite(numbers).all():
            raise ValueError(f"inputs[{name!r}] must be finite, got {numbers[~np.isfinite(numbers)][0]}")
        found[name] = jnp.asarray(value, getattr(scene.data, name).dtype)
    return found
