"""Contacts between geoms, by MJX, with the derivative that it drops for a cylinder standing on a plane.

MJX takes three points of the rim, the lowest one first, and gives the other two the height that follows from the first. Standing
upright there is no lowest point; it then picks a fixed one, and the heights of the other two no longer feel a tilt about it.
The positions of the contacts do: each lies half its distance from the rim towards the plane, n·(p - o) + d/2 is the height
of the rim above the plane, and its derivative is the right one in every pose.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjxgrad._mjx import mjx


def collide(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Fill in the contacts; a drop-in for `mjx.collision`."""
    data = mjx.collision(model, data)
    kinds = np.asarray(model.geom_type)
    is_plane, is_cylinder = (
        kinds == int(kind) for kind in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CYLINDER)
    )
    contact = data._impl.contact
    if not (is_plane.any() and is_cylinder.any() and len(contact.dist)):
        return data
    first, second = contact.geom[:, 0], contact.geom[:, 1]
    stands = jnp.asarray(is_plane)[first] & jnp.asarray(is_cylinder)[second]
    normal = contact.frame[:, 0]
    height = jnp.sum(normal * (contact.pos - data.geom_xpos[first]), axis=1) + 0.5 * contact.dist
    # The value stays MJX's own; only the derivative is replaced.
    mended = jax.lax.stop_gradient(contact.dist - height) + height
    return data.tree_replace({"_impl.contact.dist": jnp.where(stands, mended, contact.dist)})  # pyright: ignore[reportReturnType]
