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
from mjxgrad.contact.law import impedance, is_square
from mjxgrad.dynamics import spatial, tree
from mjxgrad.dynamics.block import Block
from mjxgrad.dynamics.collision import slot_geoms
from mjxgrad.dynamics.jacobian import ContactRows, DenseRows, RowMap, Side


def contacts(model: mjx.Model, data: mjx.Data, dim: int) -> Block | None:
    """Return the rows of all contacts of one dimension."""
    contact = data._impl.contact
    chosen = np.nonzero(np.asarray(contact.dim) == dim)[0]
    if not chosen.size:
        return None
    first = int(chosen[0])
    contact = jax.tree.map(lambda x: x[first : chosen[-1] + 1], contact)
    contact = contact.replace(friction=least_friction(contact.friction))
    rows = row_map(model, data, contact, first, dim)
    inverse_weight = jnp.sum(model.body_invweight0[_bodies(model, contact, first), 0], axis=1)
    if has_pyramids(model, dim):
        return _pyramids(model, contact, rows, inverse_weight, dim)
    return _cones(model, contact, rows, inverse_weight, dim)


def row_map(model: mjx.Model, data: mjx.Data, contact: Any, first: int, dim: int) -> RowMap:
    """Return the map of consecutive contacts of one dimension, the first of which has a number."""
    friction = contact.friction[:, : dim - 1] if has_pyramids(model, dim) else None
    bodies = _bodies(model, contact, first)
    if isinstance(bodies, np.ndarray):
        return contact_rows(model, data, contact, bodies, dim, friction)
    return DenseRows.of_contacts(contact_jacobian(model, data, contact.pos, contact.frame, bodies, dim), friction)


def has_pyramids(model: mjx.Model, dim: int) -> bool:
    """Return whether contacts of a dimension have the edges of a pyramid as rows."""
    return dim > 1 and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL


def _bodies(model: mjx.Model, contact: Any, first: int) -> np.ndarray | Array:
    """Return the bodies of consecutive contacts, as constants where they are known."""
    known = slot_bodies(model)
    return jnp.asarray(model.geom_bodyid)[contact.geom] if known is None else known[first : first + len(contact.dist)]


def least_friction(friction: Float[Array, "contacts 5"]) -> Float[Array, "contacts 5"]:
    """Return friction as C MuJoCo clamps it for every contact: a cone without width has no inside."""
    return jnp.where(friction > mujoco.mjMINMU, friction, mujoco.mjMINMU)


def slot_bodies(model: mjx.Model) -> np.ndarray | None:
    """Return the two bodies of each contact slot, (contacts, 2); None where it is decided at run time who gets a slot."""
    geoms = slot_geoms(model)
    return None if geoms is None else np.asarray(model.geom_bodyid)[geoms]


def contact_rows(
    model: mjx.Model, data: mjx.Data, contact: Any, bodies: np.ndarray, dim: int, friction: Array | None
) -> ContactRows:
    """Return the rows of contacts between known bodies, as the relative velocity of the two at a point."""
    moves = tree.moving_dofs(model)
    shares_root = model.body_rootid[bodies[:, 0]] == model.body_rootid[bodies[:, 1]]
    own = moves[bodies]
    own = own * (1 - own[:, ::-1] * shares_root[:, None, None])
    # The side that moves first; then the second one is needed only for contacts of two moving bodies.
    order = np.argsort(~own.any(axis=2), axis=1, kind="stable")
    num_sides = max(1, int(own.any(axis=2).sum(axis=1).max()))
    order = order[:, :num_sides]
    sides = tuple(
        tuple(Side(2.0 * k - 1, tuple(int(dof) for dof in np.nonzero(own[slot, k])[0])) for k in of_slot)
        for slot, of_slot in enumerate(order)
    )
    roots = model.body_rootid[np.take_along_axis(bodies, order, axis=1)]
    centre = spatial.pick(roots.reshape(-1), data.subtree_com).reshape(*roots.shape, 3)
    return ContactRows(contact.pos[:, None] - centre, contact.frame, data.cdof, friction, sides, dim)


def _pyramids(
    model: mjx.Model, contact: Any, rows: RowMap, inverse_weight: Float[Array, " contacts"], dim: int
) -> Block:
    """Return two opposite edges for each friction direction: J_n ± μ_k J_k."""
    mu2 = contact.friction[:, 0] ** 2
    inverse_weight = inverse_weight * (1 + mu2) * 2 * mu2 / model.opt.impratio
    residual = contact.dist - contact.includemargin
    count, each = len(residual), 2 * (dim - 1)

    def spread(x: Array) -> Array:
        return jnp.repeat(x, each, axis=0, total_repeat_length=each * count)

    is_parabola = is_square(model.geom_solimp, model.pair_solimp)
    resistance = jax.tree.map(spread, impedance(contact.solimp, residual, is_square=is_parabola))
    residual = spread(residual)
    return Block(
        map=rows,
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


def _cones(model: mjx.Model, contact: Any, rows: RowMap, inverse_weight: Float[Array, " contacts"], dim: int) -> Block:
    """Return the normal row and the rows of friction of each contact, elliptic or frictionless."""
    distance = contact.dist - contact.includemargin
    is_parabola = is_square(model.geom_solimp, model.pair_solimp)
    count = len(distance)
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
        map=rows,
        residual=residual.reshape(-1),
        impedance=jax.tree.map(spread, impedance(contact.solimp, distance, is_square=is_parabola)),
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
