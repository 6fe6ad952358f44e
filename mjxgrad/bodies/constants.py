"""Constants that MuJoCo's compiler derives from masses, inertias, lengths and sizes, computed again from the present values.

Inverse weights at the reference pose scale constraint rows: without them a derivative by a mass would miss that part of the
model.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._arrays import instance
from mjxgrad._mjx import mjx
from mjxgrad.bodies import forces, kinematics, tree

# Fields that the constants depend on, without `geom_size`, which only the bounding radii depend on.
CAUSES = {
    *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "dof_armature"),
    *("jnt_pos", "jnt_axis", "qpos0", "site_pos", "tendon_armature", "actuator_gear"),
}
_Geom = mujoco.mjtGeom
_SLIDING = 2  # `body_simple` of a childless body on slides along the world's axes: only its mass counts


def set_const(model: mjx.Model) -> mjx.Model:
    """Return a model of MJX's JAX implementation with the constants that follow from masses, inertias, lengths and sizes.

    The constants are `body_subtreemass`, `body_invweight0`, `dof_invweight0`, `dof_M0`, `tendon_invweight0`, `tendon_length0`,
    `actuator_acc0` and, for primitive geoms, `geom_rbound`. The function is traceable, differentiable with respect to all that
    they depend on, and works under `jax.vmap`. Masses and inertias are inputs here, although MuJoCo's compiler may derive them
    from a geom's size or density: a changed size changes no mass.
    """
    instance("model", model, mjx.Model, "MJX's, as scene.model")
    return model.replace(**constants_of(model))  # pyright: ignore[reportReturnType]


def constants_of(model: mjx.Model) -> dict[str, Array]:
    """Return the constants of `set_const` by name."""
    with jax.default_matmul_precision("highest"):
        # What touches does not count, and MJX has no data for some that does.
        nothing = np.zeros_like(model.geom_contype)
        alone = model.replace(geom_contype=nothing, geom_conaffinity=nothing, npair=0)  # pyright: ignore[reportCallIssue]
        data = kinematics.up_to_inertia(model, mjx.make_data(alone).replace(qpos=model.qpos0))
        mass = mjx.full_m(model, data)
        inverse, first = jnp.linalg.inv(mass), tree.first_dofs(model)
        is_same = first[:, None] == first  # of a ball joint, or half of a free joint, over which weights are averaged
        found = {
            "body_subtreemass": jnp.asarray(tree.descendants(model), mass.dtype) @ model.body_mass,
            "body_invweight0": _of_bodies(model, data, inverse),
            "dof_invweight0": jnp.asarray(is_same / is_same.sum(axis=1), mass.dtype) @ jnp.diag(inverse),
            "dof_M0": jnp.diag(mass),
            "geom_rbound": bounding_radii(model),
        }
        if model.ntendon:
            along = data._impl.ten_J
            found["tendon_invweight0"] = jnp.einsum("ti,ij,tj->t", along, inverse, along)
            found["tendon_length0"] = data.ten_length
        if model.nu:
            moment = forces.transmission(model, data)._impl.actuator_moment
            found["actuator_acc0"] = jnp.sqrt(jnp.sum((moment @ inverse) ** 2, axis=1))
    return found


def _of_bodies(model: mjx.Model, data: mjx.Data, inverse: Float[Array, "nv nv"]) -> Float[Array, "nbody 2"]:
    """Return each body's mean acceleration over directions, under a unit force and under a unit torque at its centre of mass."""
    moves = jnp.asarray(tree.moving_dofs(model), inverse.dtype)[:, :, None]
    turning, moving = data.cdof[None, :, :3] * moves, data.cdof[None, :, 3:] * moves
    lever = data.xipos - data.subtree_com[np.asarray(model.body_rootid)]
    moving = moving + jnp.cross(turning, lever[:, None])
    weights = jnp.stack([jnp.einsum("bix,ij,bjx->b", j, inverse, j) / 3 for j in (moving, turning)], axis=1)
    slides = model.body_simple == _SLIDING
    alone = 1 / jnp.where(slides, model.body_mass, 1.0)
    return jnp.where(slides[:, None], jnp.stack([alone, jnp.zeros_like(alone)], axis=1), weights)


def bounding_radii(model: mjx.Model) -> Float[Array, " ngeom"]:
    """Return the bounding radius of each primitive geom (m); other geoms keep theirs."""
    radius, half, depth = model.geom_size.T
    of_kind = {
        _Geom.mjGEOM_SPHERE: radius,
        _Geom.mjGEOM_CAPSULE: radius + half,
        _Geom.mjGEOM_CYLINDER: jnp.sqrt(radius**2 + half**2),
        _Geom.mjGEOM_ELLIPSOID: jnp.maximum(jnp.maximum(radius, half), depth),
        _Geom.mjGEOM_BOX: jnp.sqrt(radius**2 + half**2 + depth**2),
    }
    bound = model.geom_rbound
    for kind, own in of_kind.items():
        bound = jnp.where(model.geom_type == kind, own, bound)
    return bound
