"""Constraint rows of friction loss and of the limits of joints and tendons."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._math import safe_norm
from mjxgrad._mjx import mjx
from mjxgrad.contact.law import impedance, is_square
from mjxgrad.dynamics import rotation
from mjxgrad.dynamics.block import Block
from mjxgrad.dynamics.jacobian import AxisRows, DenseRows, JoinedRows, RowMap


def friction_loss(model: mjx.Model, data: mjx.Data) -> Block | None:
    """Return one row per joint velocity and tendon with friction loss."""
    dofs = np.nonzero(model._impl.dof_hasfrictionloss)[0]
    tendons = np.nonzero(model._impl.tendon_hasfrictionloss)[0]
    if not dofs.size + tendons.size:
        return None
    count, dtype = dofs.size + tendons.size, data.qvel.dtype
    maps: list[RowMap] = []
    if dofs.size:
        maps.append(AxisRows(jnp.ones(dofs.size, dtype), tuple(int(dof) for dof in dofs), model.nv))
    if tendons.size:
        maps.append(DenseRows(data._impl.ten_J[tendons]))
    zero = jnp.zeros(count, dtype)

    def join(of_dofs: Any, of_tendons: Any) -> Array:
        return jnp.concatenate([of_dofs[dofs], of_tendons[tendons]])

    solimp = join(model.dof_solimp, model.tendon_solimp_fri)
    return Block(
        map=maps[0] if len(maps) == 1 else JoinedRows(tuple(maps)),
        residual=zero,
        impedance=impedance(solimp, zero),
        solimp=solimp,
        inverse_weight=join(model.dof_invweight0, model.tendon_invweight0),
        solref=join(model.dof_solref, model.tendon_solref_fri),
        margin=zero,
        friction_loss=join(model.dof_frictionloss, model.tendon_frictionloss),
        is_active=jnp.ones(count, bool),
    )


def _limit(
    map: RowMap,
    distance: Float[Array, " rows"],
    margin: Float[Array, " rows"],
    inverse_weight: Float[Array, " rows"],
    solref: Float[Array, "rows 2"],
    solimp: Float[Array, "rows 5"],
    is_parabola: bool,
) -> Block:
    residual = distance - margin
    zero = jnp.zeros_like(residual)
    return Block(
        map,
        residual,
        impedance(solimp, residual, is_square=is_parabola),
        solimp,
        inverse_weight,
        solref,
        margin,
        zero,
        residual < 0,
        rows_each=1,
    )


def ball_limits(model: mjx.Model, data: mjx.Data) -> Block | None:
    """Return one row per limited ball joint, about the axis by which it is turned."""
    is_ball = model.jnt_type == mujoco.mjtJoint.mjJNT_BALL
    joints = np.nonzero(is_ball & np.asarray(model.jnt_limited, bool))[0]
    if not joints.size:
        return None
    quaternion = data.qpos[model.jnt_qposadr[joints][:, None] + np.arange(4)]
    turn = rotation.logarithm(quaternion / safe_norm(quaternion)[:, None])
    angle = safe_norm(turn)
    axis = turn / jnp.where(angle > 0, angle, 1.0)[:, None]
    dofs = model.jnt_dofadr[joints]
    select = np.zeros((len(joints), 3, model.nv))
    select[np.arange(len(joints))[:, None], np.arange(3), dofs[:, None] + np.arange(3)] = 1
    return _limit(
        map=DenseRows(-jnp.sum(axis[:, :, None] * jnp.asarray(select, axis.dtype), axis=1)),
        distance=jnp.max(model.jnt_range[joints], axis=1) - angle,
        margin=model.jnt_margin[joints],
        inverse_weight=model.dof_invweight0[dofs],
        solref=model.jnt_solref[joints],
        solimp=model.jnt_solimp[joints],
        is_parabola=is_square(model.jnt_solimp),
    )


def joint_limits(model: mjx.Model, data: mjx.Data) -> Block | None:
    """Return one row per limited hinge or slide, at its nearer end."""
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    joints = np.nonzero(is_scalar & np.asarray(model.jnt_limited, bool))[0]
    if not joints.size:
        return None
    position = data.qpos[model.jnt_qposadr[joints]]
    dofs = model.jnt_dofadr[joints]
    distance, sign = _nearer_end(position, model.jnt_range[joints])
    return _limit(
        map=AxisRows(sign, tuple(int(dof) for dof in dofs), model.nv),
        distance=distance,
        margin=model.jnt_margin[joints],
        inverse_weight=model.dof_invweight0[dofs],
        solref=model.jnt_solref[joints],
        solimp=model.jnt_solimp[joints],
        is_parabola=is_square(model.jnt_solimp),
    )


def tendon_limits(model: mjx.Model, data: mjx.Data) -> Block | None:
    """Return one row per limited tendon, at its nearer end."""
    tendons = np.nonzero(np.asarray(model.tendon_limited, bool))[0]
    if not tendons.size:
        return None
    distance, sign = _nearer_end(data.ten_length[tendons], model.tendon_range[tendons])
    return _limit(
        map=DenseRows(sign[:, None] * data._impl.ten_J[tendons]),
        distance=distance,
        margin=model.tendon_margin[tendons],
        inverse_weight=model.tendon_invweight0[tendons],
        solref=model.tendon_solref_lim[tendons],
        solimp=model.tendon_solimp_lim[tendons],
        is_parabola=is_square(model.tendon_solimp_lim),
    )


def _nearer_end(
    position: Float[Array, " n"], interval: Float[Array, "n 2"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the distance to the nearer end of an interval, and its derivative's sign."""
    below, above = position - interval[:, 0], interval[:, 1] - position
    is_lower = below < above
    return jnp.where(is_lower, below, above), jnp.where(is_lower, 1.0, -1.0).astype(position.dtype)
