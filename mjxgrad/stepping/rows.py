"""Constraint rows of contacts, limits and friction loss; `equality` has those of equality constraints.

A row has the residual r, the rate J v, the reference acceleration a_ref = -B J v - K d(r) r and the weight
D = d / ((1 - d) Â), with Â the inverse inertia of the row estimated at the reference pose. Connect and weld constraints also
subtract J̇ v, as in C MuJoCo.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._arrays import instance
from mjxgrad._mjx import mjx
from mjxgrad.batched import linear, maps
from mjxgrad.batched.maps import safe_norm
from mjxgrad.bodies import spatial, tree
from mjxgrad.contact.collision import slot_geoms
from mjxgrad.contact.law import Impedance, impedance, is_square, stiffness_damping
from mjxgrad.solver.jacobian import AxisRows, ContactRows, DenseRows, JoinedRows, RowMap, fold

_PerRow = Float[Array, " rows"]
_Points, _Frames = Float[Array, "contacts 3"], Float[Array, "contacts 3 3"]


class Block(eqx.Module):
    """Constraint rows of one kind, before gating and scaling. All arrays have the rows as leading axis."""

    map: RowMap  # J, from joint velocities to the rows, inactive rows included
    residual: _PerRow  # r in a_ref (m or rad)
    impedance: Impedance  # d(r), with dw and d0
    solimp: Float[Array, "rows 5"]
    inverse_weight: _PerRow  # Â, inverse inertia (1/kg)
    solref: Float[Array, "rows 2"]
    margin: _PerRow  # distance at which the row begins (m or rad)
    friction_loss: _PerRow  # largest force of a friction loss row
    is_active: Bool[Array, " rows"]
    drift: _PerRow | None = None  # J̇ v, the change of the rate without joint accelerations (m/s² or rad/s²)
    # Number of consecutive rows of each contact or limit, which begin and end together; 0 if none does.
    rows_each: int = eqx.field(static=True, default=0, kw_only=True)
    # Whether the rows are edges of pyramids, whose mean is the normal row; otherwise the first row is.
    is_pyramid: bool = eqx.field(static=True, default=False, kw_only=True)
    # First slot of contacts, and one after the last; None for other rows.
    slots: tuple[int, int] | None = eqx.field(static=True, default=None, kw_only=True)


def joined(blocks: list[Block]) -> Block:
    """Return all rows as one block, without `rows_each`, `is_pyramid` and `slots`."""
    if any(block.drift is not None for block in blocks):
        still = [jnp.zeros_like(x.residual) if x.drift is None else x.drift for x in blocks]
        blocks = [dataclasses.replace(x, drift=drift) for x, drift in zip(blocks, still, strict=True)]
    leaves = {
        field.name: jax.tree.map(lambda *x: jnp.concatenate(x), *(getattr(block, field.name) for block in blocks))
        for field in dataclasses.fields(Block)
        if field.name != "map" and not field.metadata.get("static")
    }
    return Block(JoinedRows(tuple(block.map for block in blocks)), **leaves)  # pyright: ignore[reportArgumentType]


def law(model: mjx.Model, qvel: Float[Array, " nv"], block: Block) -> tuple[_PerRow, _PerRow]:
    """Return a_ref and weight D of rows; a_ref of inactive rows is zero, and they have no effect."""
    residual = jnp.where(block.is_active, block.residual, 0.0)
    rate = jnp.where(block.is_active, block.map.mv(qvel), 0.0)
    stiffness, damping = stiffness_damping(model, block.solref, block.impedance.full)
    present = block.impedance.present
    drift = 0.0 if block.drift is None else jnp.where(block.is_active, block.drift, 0.0)
    return -damping * rate - stiffness * present * residual - drift, weight_of(block, present)


def weight_of(block: Block, impedance: _PerRow) -> _PerRow:
    """Return the weight D of rows at an impedance."""
    return 1 / jnp.maximum(block.inverse_weight * (1 - impedance) / impedance, mujoco.mjMINVAL)


def contacts(model: mjx.Model, data: mjx.Data, dim: int) -> Block | None:
    """Return the rows of all contacts of one dimension."""
    # A pyramid has two opposite edges J_n ± μ_k J_k for each direction of friction. Other contacts have a normal row,
    # then rows of friction.
    contact = data._impl.contact
    chosen = np.nonzero(np.asarray(contact.dim) == dim)[0]
    if not chosen.size:
        return None
    first = int(chosen[0])
    contact = jax.tree.map(lambda x: x[first : chosen[-1] + 1], contact)
    contact = contact.replace(friction=least_friction(contact.friction))
    rows = row_map(model, data, contact, first, dim)
    inverse_weight = jnp.sum(model.body_invweight0[_bodies(model, data, contact, first), 0], axis=1)
    distance = contact.dist - contact.includemargin
    is_pyramid, count = has_pyramids(model, dim), len(distance)
    each = 2 * (dim - 1) if is_pyramid else dim
    spread = functools.partial(jnp.repeat, repeats=each, axis=0)
    if is_pyramid:
        mu2 = contact.friction[:, 0] ** 2
        inverse_weight = spread(inverse_weight * (1 + mu2) * 2 * mu2 / model.opt.impratio)
        residual, solref = spread(distance), spread(contact.solref)
    else:
        residual = jnp.zeros((count, dim), distance.dtype).at[:, 0].set(distance).reshape(-1)
        inverse_weight, solref = _cone_rows(model, contact, inverse_weight, dim)
    is_parabola = is_square(model.geom_solimp, model.pair_solimp)
    return Block(
        map=rows,
        residual=residual,
        impedance=jax.tree.map(spread, impedance(contact.solimp, distance, is_square=is_parabola)),
        solimp=spread(contact.solimp),
        inverse_weight=inverse_weight,
        solref=solref,
        margin=spread(contact.includemargin),
        friction_loss=jnp.zeros_like(residual),
        is_active=residual < 0 if is_pyramid else spread(distance < 0),
        rows_each=each,
        is_pyramid=is_pyramid,
        slots=(first, first + count),
    )


def _cone_rows(
    model: mjx.Model, contact: Any, inverse_weight: Float[Array, " contacts"], dim: int
) -> tuple[_PerRow, Float[Array, "rows 2"]]:
    weights, solref = [inverse_weight[:, None]], [contact.solref[:, None]]
    if dim > 1:
        friction2 = contact.friction[:, : dim - 1] ** 2
        tangential = inverse_weight[:, None] / model.opt.impratio
        weights.append(tangential * friction2[:, :1] / friction2)
        given = jnp.any(contact.solreffriction != 0, axis=1, keepdims=True)
        of_friction = jnp.where(given, contact.solreffriction, contact.solref)
        solref.append(jnp.broadcast_to(of_friction[:, None], (len(inverse_weight), dim - 1, 2)))
    return jnp.concatenate(weights, axis=1).reshape(-1), jnp.concatenate(solref, axis=1).reshape(-1, 2)


def row_map(model: mjx.Model, data: mjx.Data, contact: Any, first: int, dim: int) -> RowMap:
    """Return the map of consecutive contacts of one dimension, from slot `first` on."""
    # A row of a contact between known bodies is their relative velocity at a point.
    friction = contact.friction[:, : dim - 1] if has_pyramids(model, dim) else None
    bodies = _bodies(model, data, contact, first)
    if not isinstance(bodies, np.ndarray):
        return DenseRows(contact_jacobian(model, data, contact.pos, contact.frame, bodies, dim), friction)
    moves = tree.moving_dofs(model)
    shares_root = model.body_rootid[bodies[:, 0]] == model.body_rootid[bodies[:, 1]]
    own = moves[bodies]
    own = own * (1 - own[:, ::-1] * shares_root[:, None, None])
    # Moving sides come first; the second is needed only for contacts of two moving bodies.
    order = np.argsort(~own.any(axis=2), axis=1, kind="stable")
    num_sides = max(1, int(own.any(axis=2).sum(axis=1).max()))
    order = order[:, :num_sides]
    sides = tuple(
        tuple((2.0 * k - 1, tuple(np.flatnonzero(own[slot, k]).tolist())) for k in of_slot)
        for slot, of_slot in enumerate(order.tolist())
    )
    roots = model.body_rootid[np.take_along_axis(bodies, order, axis=1)]
    centre = maps.pick(roots.reshape(-1), data.subtree_com).reshape(*roots.shape, 3)
    return ContactRows(contact.pos[:, None] - centre, contact.frame, data.cdof, friction, sides, dim)


def has_pyramids(model: mjx.Model, dim: int) -> bool:
    """Return whether contacts of a dimension have the edges of pyramids as rows."""
    return dim > 1 and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL


def _bodies(model: mjx.Model, data: mjx.Data, contact: Any, first: int) -> np.ndarray | Array:
    slots = slot_geoms(model, data)
    if slots is None:
        return jnp.asarray(model.geom_bodyid)[contact.geom]
    return np.asarray(model.geom_bodyid)[slots[first : first + len(contact.dist)]]


def least_friction(friction: Float[Array, "contacts 5"]) -> Float[Array, "contacts 5"]:
    """Return friction, clamped from below as in C MuJoCo: a cone of zero width has no interior."""
    return jnp.where(friction > mujoco.mjMINMU, friction, mujoco.mjMINMU)


def contact_jacobian(
    model: mjx.Model, data: mjx.Data, position: _Points, frame: _Frames, bodies: Array | np.ndarray, dim: int
) -> Float[Array, "contacts dim nv"]:
    """Return the Jacobian of the relative velocity of two bodies at points, in the points' frames, as in `ContactRows`."""
    # The second body counts positive, the first negative.
    moves = jnp.asarray(tree.moving_dofs(model), position.dtype)[bodies]  # contacts, 2, nv
    lever = position[:, None] - maps.choose(jnp.asarray(model.body_rootid)[bodies], data.subtree_com)
    signs = moves * jnp.array([-1.0, 1.0], position.dtype)[:, None]
    turning, moving = data.cdof[:, :3], data.cdof[:, 3:]
    # A joint velocity moves both sides alike, about the same point if they have the same root.
    sign, arm = signs[:, 0] + signs[:, 1], maps.contract("csv,csx->cvx", signs, lever)
    turned = spatial.cross(jnp.broadcast_to(turning, arm.shape), arm)
    point = maps.contract("cv,vx->cvx", sign, moving) + turned
    rows = maps.contract("ckx,cvx->ckv", frame[:, : min(dim, 3)], point)
    if dim > 3:
        spin = maps.contract("cv,vx->cvx", sign, turning)
        rows = jnp.concatenate([rows, maps.contract("ckx,cvx->ckv", frame[:, : dim - 3], spin)], axis=1)
    return rows


def contact_force(model: mjx.Model, data: mjx.Data, first: str, second: str) -> Float[Array, "3"]:
    """Return the force that the first geom exerts on the second through all their contacts.

    It is meant for `observe=` of a rollout: `lambda model, data: mg.contact_force(model, data, "floor", "foot")`. The data has
    constraint forces, as after `forward` or a step by MJX. By C MuJoCo and Warp a contact sensor of the scene tells the same.

    Returns:
        The force in world coordinates (N); zero where they do not touch. It does not include torques of friction.

    Raises:
        ValueError: if there is no such geom, or the two can never touch.
    """
    wanted = [index_of(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in (first, second)]
    contact, known = data._impl.contact, slot_geoms(model, data)
    slots = range(len(contact.dim)) if known is None else np.flatnonzero((np.sort(known) == sorted(wanted)).all(axis=1))
    if not len(slots):
        raise ValueError(f"{first!r} and {second!r} can never touch: no contact between them is simulated")
    total = jnp.zeros(3, data.qpos.dtype)
    for slot in slots:
        dim, address = int(contact.dim[slot]), int(contact.efc_address[slot])
        # MuJoCo's normal points from the first geom to the second, in the direction of the force on the second.
        along, against = (jnp.all(contact.geom[slot] == jnp.array(pair)) for pair in (wanted, wanted[::-1]))
        has_pyramid = has_pyramids(model, dim)
        force = data._impl.efc_force[address : address + (2 * (dim - 1) if has_pyramid else dim)]
        if has_pyramid:
            force = fold(force[None], least_friction(contact.friction[slot : slot + 1])[:, : dim - 1])[0]
        num_axes = min(dim, 3)
        total += (along.astype(total.dtype) - against) * force[:num_axes] @ contact.frame[slot, :num_axes]
    return total


def index_of(model: mjx.Model | mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """Return the index of a named body, joint, geom, site, sensor, actuator or camera; refuse an unknown name."""
    instance("model", model, mjx.Model | mujoco.MjModel, "MJX's, as scene.model")
    word = kind.name.removeprefix("mjOBJ_").lower()
    count = {"joint": "njnt", "actuator": "nu", "camera": "ncam"}.get(word, f"n{word}")
    names = [mjx.id2name(model, kind, index) for index in range(getattr(model, count))]
    if name not in names:
        listed = ", ".join(repr(one) for one in names if one) or "none"
        raise ValueError(
            f"there is no {word} {name!r}; named {'bodies' if word == 'body' else f'{word}s'} are {listed}"
        )
    return names.index(name)


def friction_loss(model: mjx.Model, data: mjx.Data) -> Block | None:
    """Return one row per joint velocity and tendon with friction loss."""
    dofs = np.nonzero(model._impl.dof_hasfrictionloss)[0]
    tendons = np.nonzero(model._impl.tendon_hasfrictionloss)[0]
    if not dofs.size + tendons.size:
        return None
    count, dtype = dofs.size + tendons.size, data.qvel.dtype
    parts: list[RowMap] = []
    if dofs.size:
        parts.append(AxisRows(jnp.ones(dofs.size, dtype), tuple(dofs.tolist()), model.nv))
    if tendons.size:
        parts.append(DenseRows(data._impl.ten_J[tendons][:, None]))
    zero = jnp.zeros(count, dtype)

    def join(of_dofs: Any, of_tendons: Any) -> Array:
        return jnp.concatenate([of_dofs[dofs], of_tendons[tendons]])

    solimp = join(model.dof_solimp, model.tendon_solimp_fri)
    return Block(
        map=parts[0] if len(parts) == 1 else JoinedRows(tuple(parts)),
        residual=zero,
        impedance=impedance(solimp, zero),
        solimp=solimp,
        inverse_weight=join(model.dof_invweight0, model.tendon_invweight0),
        solref=join(model.dof_solref, model.tendon_solref_fri),
        margin=zero,
        friction_loss=join(model.dof_frictionloss, model.tendon_frictionloss),
        is_active=jnp.ones(count, bool),
    )


def limits(model: mjx.Model, data: mjx.Data) -> list[Block | None]:
    """Return the rows of limited ball joints, of other limited joints, and of limited tendons."""
    is_limited = np.asarray(model.jnt_limited, bool)
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    balls = np.nonzero(is_limited & (model.jnt_type == mujoco.mjtJoint.mjJNT_BALL))[0]
    joints = np.nonzero(is_limited & is_scalar)[0]
    tendons = np.nonzero(np.asarray(model.tendon_limited, bool))[0]
    of_joints = (model.jnt_margin, model.jnt_solref, model.jnt_solimp)
    of_tendons = (model.tendon_margin, model.tendon_solref_lim, model.tendon_solimp_lim)
    blocks: list[Block | None] = [None, None, None]
    if balls.size:
        dofs = model.jnt_dofadr[balls]
        blocks[0] = one_sided(*_ball_limit(model, data, balls), model.dof_invweight0[dofs], balls, *of_joints)
    if joints.size:
        dofs = model.jnt_dofadr[joints]
        position = linear.take(data.qpos, tuple(model.jnt_qposadr[joints].tolist()))
        distance, sign = _nearer_end(position, model.jnt_range[joints])
        rows = AxisRows(sign, tuple(dofs.tolist()), model.nv)
        blocks[1] = one_sided(rows, distance, model.dof_invweight0[dofs], joints, *of_joints)
    if tendons.size:
        distance, sign = _nearer_end(data.ten_length[tendons], model.tendon_range[tendons])
        rows = DenseRows((sign[:, None] * data._impl.ten_J[tendons])[:, None])
        blocks[2] = one_sided(rows, distance, model.tendon_invweight0[tendons], tendons, *of_tendons)
    return blocks


def one_sided(
    map: RowMap, distance: _PerRow, inverse_weight: _PerRow, chosen: np.ndarray, margin: Any, solref: Any, solimp: Any
) -> Block:
    """Return one-sided rows, one per chosen item; margin, solref and solimp are those of all items."""
    margins, solimps = margin[chosen], solimp[chosen]
    residual = distance - margins
    return Block(
        map=map,
        residual=residual,
        impedance=impedance(solimps, residual, is_square=is_square(solimp)),
        solimp=solimps,
        inverse_weight=inverse_weight,
        solref=solref[chosen],
        margin=margins,
        friction_loss=jnp.zeros_like(residual),
        is_active=residual < 0,
        rows_each=1,
    )


def _ball_limit(model: mjx.Model, data: mjx.Data, joints: np.ndarray) -> tuple[RowMap, _PerRow]:
    """Return map and distance to the limit of ball joints, about each joint's present axis of rotation."""
    quaternion = data.qpos[model.jnt_qposadr[joints][:, None] + np.arange(4)]
    turn = spatial.logarithm(quaternion / safe_norm(quaternion)[:, None])
    angle = safe_norm(turn)
    # At a smaller angle, whose square underflows in single precision, the axis is zero; no limit is near there.
    axis = turn / jnp.where(angle > 1e-12, angle, 1.0)[:, None]
    select = np.zeros((len(joints), 3, model.nv))
    select[np.arange(len(joints))[:, None], np.arange(3), model.jnt_dofadr[joints][:, None] + np.arange(3)] = 1
    rows = DenseRows(-jnp.sum(axis[:, :, None] * jnp.asarray(select, axis.dtype), axis=1, keepdims=True))
    return rows, jnp.max(model.jnt_range[joints], axis=1) - angle


def _nearer_end(position: _PerRow, interval: Float[Array, "rows 2"]) -> tuple[_PerRow, _PerRow]:
    """Return the distance to the nearer end of an interval, and the sign of its derivative."""
    below, above = position - interval[:, 0], interval[:, 1] - position
    is_lower = below < above
    return jnp.where(is_lower, below, above), jnp.where(is_lower, 1.0, -1.0).astype(position.dtype)
