"""The force between two geoms, by name."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics.collision import slot_geoms
from mjxgrad.dynamics.contact import has_pyramids, least_friction
from mjxgrad.dynamics.jacobian import fold


def contact_force(model: mjx.Model, data: mjx.Data, first: str, second: str) -> Float[Array, "3"]:
    """Return the force that one geom exerts on another through all their contacts.

    For `observe=` of a rollout: `lambda model, data: mg.contact_force(model, data, "floor", "foot")`.

    Args:
        model: the scene's.
        data: with the forces of its constraints, as `forward`, a step or a rollout leaves them.
        first: name of the geom that pushes.
        second: name of the geom that is pushed.

    Returns:
        The force in world coordinates (N); zero where they do not touch. Torques of friction are not in it.

    Raises:
        ValueError: if there is no such geom, or no contact between the two.
    """
    wanted = [_number(model, name) for name in (first, second)]
    contact, known = data._impl.contact, slot_geoms(model)
    slots = range(len(contact.dim)) if known is None else np.flatnonzero((np.sort(known) == sorted(wanted)).all(axis=1))
    total = jnp.zeros(3, data.qpos.dtype)
    for slot in slots:
        dim, address = int(contact.dim[slot]), int(contact.efc_address[slot])
        # MuJoCo's normal points from the first geom to the second, which the force pushes away.
        along, against = (jnp.all(contact.geom[slot] == jnp.array(pair)) for pair in (wanted, wanted[::-1]))
        sign = along.astype(total.dtype) - against
        has_pyramid = has_pyramids(model, dim)
        num_rows = 2 * (dim - 1) if has_pyramid else dim
        force = data._impl.efc_force[address : address + num_rows]
        if has_pyramid:
            force = fold(force[None], least_friction(contact.friction[slot : slot + 1])[:, : dim - 1])[0]
        num_axes = min(dim, 3)
        total += sign * force[:num_axes] @ contact.frame[slot, :num_axes]
    if not len(slots):
        raise ValueError(f"{first!r} and {second!r} can never touch: no contact between them is simulated")
    return total


def _number(model: mjx.Model, name: str) -> int:
    names = {
        model.names[address:].split(b"\0", 1)[0].decode(): number
        for number, address in enumerate(np.asarray(model.name_geomadr))
    }
    if name not in names:
        known = ", ".join(repr(one) for one in names if one)
        raise ValueError(f"there is no geom {name!r}; named geoms are {known or 'none'}")
    return names[name]
