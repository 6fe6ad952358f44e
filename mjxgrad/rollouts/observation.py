"""Observations of a state that C MuJoCo steps: its sensors, and the places of bodies, geoms and sites."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad.bodies.kinematics import com_pos, kinematics
from mjxgrad.engines import sense
from mjxgrad.rollouts.arguments import Observe, arguments_of
from mjxgrad.rollouts.state import State, data_of
from mjxgrad.scene import Scene

_PLACES = (
    "xpos",
    "xquat",
    "xmat",
    "xipos",
    "ximat",
    "xanchor",
    "xaxis",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
    "subtree_com",
)


def observed(
    scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: dict[str, Array], observe: Observe
) -> PyTree:
    """Return what a function of model and data sees in a state under a control, by C MuJoCo's sensors."""
    start, resting = arguments_of(scene, state)
    given = {name: value[None] for name, value in (resting | inputs | {"ctrl": ctrl}).items()}
    readings = sense(scene, {name: value[None] for name, value in start.items()}, given)[0]
    known = {"qpos": state.qpos, "qvel": state.qvel, "act": state.act, "ctrl": ctrl, "time": state.time, **inputs}
    at = data_of(scene, state, ctrl).replace(**inputs)
    placed = com_pos(scene.model, kinematics(scene.model, at))
    known |= {name: getattr(placed, name) for name in _PLACES if hasattr(placed, name)} | {"sensordata": readings}

    def unknown(value: Any) -> Any:
        is_number = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)
        return jnp.full_like(value, jnp.nan) if is_number else value

    # Forces and accelerations that only C MuJoCo has would be zeros of the template.
    data: mjx.Data = jax.tree.map(unknown, scene.data).replace(**known)
    return observe(scene.model.replace(sensor_needstage=scene.mj_model.sensor_needstage), data)  # pyright: ignore[reportCallIssue]
