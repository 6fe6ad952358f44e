"""Constraint rows of contacts: pyramids, elliptic cones, frictionless."""

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import tree
from mjxgrad.dynamics.block import Block, impedance


def contacts(model: mjx.Model, data: mjx.Data, dim: int) -> Block | None:
    """Return the rows of all contacts of one dimension."""
    contact = data._impl.contact
    chosen = np.nonzero(np.asarray(contact.dim) == dim)[0]
    if not chosen.size:
        return None
    contact = jax.tree.map(lambda x: x[chosen[0] : chosen[-1] + 1], contact)
    bodies = jnp.asarray(model.geom_bodyid)[contact.geom]
    directions = contact_jacobian(model, data, contact.pos, contact.frame, bodies, dim)
    inverse_weight = jnp.sum(model.body_invweight0[bodies, 0], axis=1)
    if dim > 1 and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return _pyramids(model, contact, directions, inverse_weight)
    return _cones(model, contact, directions, inverse_weight)


def _pyramids(
    model: mjx.Model,
    contact: Any,
    directions: Float[Array, "contacts dim nv"],
    inverse_weight: Float[Array, " contacts"],
) -> Block:
    """Return two opposite edges for each friction direction: J_n ± μ_k J_k."""
    count, dim = directions.shape[:2]
    friction = contact.friction[:, : dim - 1, None]
    tilt = friction * directions[:, 1:]
    edges = jnp.stack([directions[:, :1] + tilt, directions[:, :1] - tilt], axis=2)
    mu2 = contact.friction[:, 0] ** 2
    inverse_weight = inverse_weight * (1 + mu2) * 2 * mu2 / model.opt.impratio
    residual = contact.dist - contact.includemargin
    each = 2 * (dim - 1)

    def spread(x: Array) -> Array:
        return jnp.repeat(x, each, axis=0, total_repeat_length=each * count)

    resistance = spread(impedance(contact.solimp, residual))
    residual = spread(residual)
    return Block(
        jacobian=edges.reshape(count * each, -1),
        residual=residual,
        impedance=resistance,
        solimp=spread(contact.solimp),
        inverse_weight=spread(inverse_weight),
        solref=spread(contact.solref),
        margin=spread(contact.includemargin),
        friction_loss=jnp.zeros_like(residual),
        is_active=residual < 0,
        rows_each=each,
        is_pyramid=True,
        is_contact=True,
    )


def _cones(
    model: mjx.Model,
    contact: Any,
    directions: Float[Array, "contacts dim nv"],
    inverse_weight: Float[Array, " contacts"],
) -> Block:
    """Return the normal row and the rows of friction of each contact, elliptic or frictionless."""
    count, dim = directions.shape[:2]
    distance = contact.dist - contact.includemargin
    residual = jnp.zeros((count, dim), distance.dtype).at[:, 0].set(distance)
    weights, solref = [inverse_weight[:, None]], [contact.solref[:, None]]
    if dim > 1:
        friction2 = contact.friction[:, : dim - 1] ** 2
        tangential = inverse_weight[:, None] / model.opt.impratio
        weights.append(tangential * friction2[:, :1] / friction2)
        given = jnp.any(contact.solreffriction != 0, axis=1, keepdims=True)
        of_friction = jnp.where(given, contact.solreffriction, contact.solref)
        solref.append(jnp.broadcast_to(of_friction[:, None], (count, dim - 1, 2)))

    def spread(x: Array) -> Array:
        return jnp.repeat(x, dim, axis=0, total_repeat_length=dim * count)

    return Block(
        jacobian=directions.reshape(count * dim, -1),
        residual=residual.reshape(-1),
        impedance=spread(impedance(contact.solimp, distance)),
        solimp=spread(contact.solimp),
        inverse_weight=jnp.concatenate(weights, axis=1).reshape(-1),
        solref=jnp.concatenate(solref, axis=1).reshape(-1, 2),
        margin=spread(contact.includemargin),
        friction_loss=jnp.zeros(count * dim, distance.dtype),
        is_active=spread(distance < 0),
        rows_each=dim,
        is_contact=True,
    )


def contact_jacobian(
    model: mjx.Model,
    data: mjx.Data,
    position: Float[Array, "contacts 3"],
    frame: Float[Array, "contacts 3 3"],
    bodies: Array | np.ndarray,
    dim: int,
) -> Float[Array, "contacts dim nv"]:
    """Return the Jacobian of the relative velocity of two bodies at points, in the points' frames.

    A unit force along a frame axis, taken as a wrench about the centre of mass that the joint axes refer to, does work
    on a joint velocity at the rate (axis · wrench). The second body counts positive, the first negative.
    """
    moves = jnp.asarray(tree.moving_dofs(model), position.dtype)[bodies]  # contacts, 2, nv
    centre = data.subtree_com[jnp.asarray(model.body_rootid)[bodies]]
    num_axes = min(dim, 3)
    force = frame[:, :num_axes]
    signs = (-moves[:, 0], moves[:, 1])
    rows = jnp.zeros((len(position), num_axes, model.nv), position.dtype)
    for side in (0, 1):
        torque = jnp.cross((position - centre[:, side])[:, None], force)
        wrench = jnp.concatenate([torque, force], axis=-1)
        rows += signs[side][:, None] * _dot_axes(wrench, data.cdof)
    if dim > 3:
        turning = (signs[0] + signs[1])[:, None] * _dot_axes(frame[:, : dim - 3], data.cdof[:, :3])
        rows = jnp.concatenate([rows, turning], axis=1)
    return rows


def _dot_axes(wrench: Float[Array, "contacts k n"], axes: Float[Array, "nv n"]) -> Float[Array, "contacts k nv"]:
    # Written out: XLA's CPU backend crashed on the derivative of the reduction under two jax.vmap (jax 0.10.2).
    return functools.reduce(operator.add, (wrench[:, :, None, i] * axes[:, i] for i in range(axes.shape[1])))
