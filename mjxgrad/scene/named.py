"""What a scene's sensors read and where its sites are, by name: for `observe=`, beside `contact_force`, called alike."""

import mujoco
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics.rows import index_of


def sensor(model: mjx.Model, data: mjx.Data, name: str) -> Float[Array, " dim"]:
    """Return what a sensor reads.

    Args:
        model: the scene's.
        data: with its sensors computed, as `forward`, a step or a rollout leaves them.
        name: of the sensor.

    Returns:
        Its numbers, in MuJoCo's units of that sensor; one for a touch sensor, three for a force.

    Raises:
        ValueError: if there is no such sensor, or MJX cannot compute it.
    """
    index = index_of(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if model.sensor_needstage[index] == mujoco.mjtStage.mjSTAGE_NONE:
        raise ValueError(f"sensor {name!r} would read 0: MJX cannot compute it, as the scene's summary says")
    start = int(model.sensor_adr[index])
    return data.sensordata[start : start + int(model.sensor_dim[index])]


def site_position(model: mjx.Model, data: mjx.Data, name: str) -> Float[Array, "3"]:
    """Return where a site is, in world coordinates (m).

    Args:
        model: the scene's.
        data: with its positions computed, as `forward`, a step or a rollout leaves them.
        name: of the site.

    Raises:
        ValueError: if there is no such site.
    """
    return data.site_xpos[index_of(model, mujoco.mjtObj.mjOBJ_SITE, name)]
