r"""Constraint rows of a state: Jacobian, reference acceleration and weight.

The same rows in the same order as `mjx.make_constraint`, so that `mjx.Data` keeps its meaning, formed differently for two
reasons. Derivatives: MJX's impedance is NaN beyond its width, its stiffness is NaN for a direct solref without damping, and its
norms have no derivative near zero. Speed: a contact's Jacobian is here one product of wrenches with the joint axes, for
all contacts at once, and the impedance is evaluated once per contact, not once per pyramid edge.

A row has residual r, rate J v, and asks for a_ref = -B J v - K d(r) r, with weight D = d / ((1 - d) Â), Â the inverse inertia
of the row estimated at the reference pose.

References:
    MuJoCo documentation, "Modeling", "Solver parameters"; "Computation", "Constraint model".
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import rotation
from mjxgrad.dynamics.constraint import ConeGroup, RowLayout, Rows

_CONDIMS = (1, 3, 4, 6)


class Block(eqx.Module):
    """Constraint rows of one kind, before gating and scaling. All fields have the rows as leading axis.

    Attributes:
        jacobian: from joint velocities to the rows, also where the row is inactive.
        residual: r in a_ref (m or rad).
        impedance: d(r), and dw, its value from the width on.
        inverse_weight: Â, inverse inertia (1/kg).
        solref: stiffness and damping in MuJoCo's formats.
        margin: distance at which the row begins (m or rad).
        friction_loss: largest force of a friction loss row.
        is_active: whether the row takes part.
    """

    jacobian: Float[Array, "rows nv"]
    residual: Float[Array, " rows"]
    impedance: Float[Array, "rows 2"]
    inverse_weight: Float[Array, " rows"]
    solref: Float[Array, "rows 2"]
    margin: Float[Array, " rows"]
    friction_loss: Float[Array, " rows"]
    is_active: Bool[Array, " rows"]


def row_layout(model: mjx.Model, data: mjx.Data) -> RowLayout:
    """Return which law holds on which rows of this data."""
    impl, cones = data._impl, []
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        for dim in _CONDIMS[1:]:
            is_dim = np.asarray(impl.contact.dim) == dim
            if is_dim.any():
                start = int(np.asarray(impl.contact.efc_address)[is_dim][0])
                cones.append(ConeGroup(start, int(is_dim.sum()), dim))
    return RowLayout(int(impl.ne), int(impl.nf), int(impl.nefc), tuple(cones))


def make_constraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Fill the `efc_` fields; a drop-in for `mjx.make_constraint`."""
    blocks = [block for block in _blocks(model, data) if block is not None]
    if not blocks:
        empty = jnp.zeros(0, data.qpos.dtype)
        fields = dict.fromkeys(("D", "aref", "frictionloss", "pos", "margin"), empty)
        fields["J"] = jnp.zeros((0, model.nv), data.qpos.dtype)
    else:
        block = jax.tree.map(lambda *x: jnp.concatenate(x), *blocks)
        jacobian = jnp.where(block.is_active[:, None], block.jacobian, 0.0)
        residual = jnp.where(block.is_active, block.residual, 0.0)
        stiffness, damping = _stiffness_damping(model, block)
        impedance = block.impedance[:, 0]
        weight = 1 / jnp.maximum(block.inverse_weight * (1 - impedance) / impedance, mujoco.mjMINVAL)
        fields = {
            "J": jacobian,
            "D": weight,
            "aref": -damping * (jacobian @ data.qvel) - stiffness * impedance * residual,
            "frictionloss": block.friction_loss,
            "pos": residual + block.margin,
            "margin": block.margin,
        }
    return data.tree_replace({f"_impl.efc_{name}": value for name, value in fields.items()})


def rows_of(model: mjx.Model, data: mjx.Data, layout: RowLayout) -> Rows:
    """Return the parameters of the rows' laws from assembled data."""
    impl, scales = data._impl, []
    for group in layout.cones:
        friction = impl.contact.friction[np.asarray(impl.contact.dim) == group.dim]
        friction = friction[:, : group.dim - 1]
        mu = friction[:, :1] / jnp.sqrt(model.opt.impratio)
        scales.append(jnp.concatenate([mu, friction], axis=1))
    return Rows(impl.efc_aref, impl.efc_D, impl.efc_frictionloss, tuple(scales))


def _blocks(model: mjx.Model, data: mjx.Data) -> list[Block | None]:
    disabled = model.opt.disableflags
    bits = mujoco.mjtDisableBit
    if disabled & bits.mjDSBL_CONSTRAINT:
        return []
    blocks: list[Block | None] = []
    if not disabled & bits.mjDSBL_EQUALITY and model.neq:
        from mjxgrad.dynamics import equality

        blocks += equality.blocks(model, data)
    if not disabled & bits.mjDSBL_FRICTIONLOSS:
        blocks.append(_friction_loss(model, data))
    if not disabled & bits.mjDSBL_LIMIT:
        blocks += [_ball_limits(model, data), _joint_limits(model, data), _tendon_limits(model, data)]
    blocks += [_contacts(model, data, dim) for dim in _CONDIMS]
    return blocks


def _stiffness_damping(model: mjx.Model, block: Block) -> tuple[Float[Array, " rows"], Float[Array, " rows"]]:
    """Return K and B of each row.

    Each format is evaluated on numbers that are its own, so that no infinity of the other enters the derivative. Under
    refsafe the time constant is clamped from below at two time steps; at the clamp itself the derivative is that of the
    unclamped side, since from there every larger value counts.
    """
    first, second, largest = block.solref[:, 0], block.solref[:, 1], block.impedance[:, 1]
    time_constant = jnp.where(first > 0, first, 1.0)
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        shortest = 2 * model.opt.timestep
        time_constant = jnp.where(time_constant >= shortest, time_constant, shortest)
    ratio = jnp.where(second > 0, second, 1.0)
    stiffness = jnp.where(first > 0, 1 / (largest * time_constant * ratio) ** 2, -first / largest**2)
    damping = jnp.where(second > 0, 2 / (largest * time_constant), -second / largest)
    return stiffness, damping


def impedance(solimp: Float[Array, "n 5"], violation: Float[Array, " n"]) -> Float[Array, "n 2"]:
    """Return d(r) and dw: from d0 at r = 0 to dw at the width, along two power laws that meet at the midpoint."""
    smallest = jnp.clip(solimp[:, 0], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    largest = jnp.clip(solimp[:, 1], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    width = jnp.maximum(solimp[:, 2], mujoco.mjMINVAL)
    middle = jnp.clip(solimp[:, 3], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    power = jnp.maximum(solimp[:, 4], 1.0)
    # Beyond the width the powers are evaluated where they are finite and thrown away.
    is_inside = jnp.abs(violation) < width
    x = jnp.where(is_inside, jnp.abs(violation) / width, 0.5)
    is_lower = x < middle
    part = jnp.where(is_lower, middle, 1 - middle)
    climb = part * (jnp.where(is_lower, x, 1 - x) / part) ** power
    inside = smallest + (largest - smallest) * jnp.where(is_lower, climb, 1 - climb)
    return jnp.stack([jnp.where(is_inside, inside, largest), largest], axis=1)


def _friction_loss(model: mjx.Model, data: mjx.Data) -> Block | None:
    dofs = np.nonzero(model._impl.dof_hasfrictionloss)[0]
    tendons = np.nonzero(model._impl.tendon_hasfrictionloss)[0]
    if not dofs.size + tendons.size:
        return None
    jacobian = jnp.concatenate([jnp.eye(model.nv)[dofs], data._impl.ten_J[tendons]])
    zero = jnp.zeros(len(jacobian), jacobian.dtype)

    def join(of_dofs: Any, of_tendons: Any) -> Array:
        return jnp.concatenate([of_dofs[dofs], of_tendons[tendons]])

    return Block(
        jacobian=jacobian,
        residual=zero,
        impedance=impedance(join(model.dof_solimp, model.tendon_solimp_fri), zero),
        inverse_weight=join(model.dof_invweight0, model.tendon_invweight0),
        solref=join(model.dof_solref, model.tendon_solref_fri),
        margin=zero,
        friction_loss=join(model.dof_frictionloss, model.tendon_frictionloss),
        is_active=jnp.ones(len(jacobian), bool),
    )


def _limit(
    jacobian: Float[Array, "rows nv"],
    distance: Float[Array, " rows"],
    margin: Float[Array, " rows"],
    inverse_weight: Float[Array, " rows"],
    solref: Float[Array, "rows 2"],
    solimp: Float[Array, "rows 5"],
) -> Block:
    residual = distance - margin
    zero = jnp.zeros_like(residual)
    return Block(
        jacobian,
        residual,
        impedance(solimp, residual),
        inverse_weight,
        solref,
        margin,
        zero,
        residual < 0,
    )


def _ball_limits(model: mjx.Model, data: mjx.Data) -> Block | None:
    is_ball = model.jnt_type == mujoco.mjtJoint.mjJNT_BALL
    joints = np.nonzero(is_ball & np.asarray(model.jnt_limited, bool))[0]
    if not joints.size:
        return None
    quaternion = data.qpos[model.jnt_qposadr[joints][:, None] + np.arange(4)]
    turn = rotation.logarithm(quaternion / rotation.safe_norm(quaternion)[:, None])
    angle = rotation.safe_norm(turn)
    axis = turn / jnp.where(angle > 0, angle, 1.0)[:, None]
    dofs = model.jnt_dofadr[joints]
    select = np.zeros((len(joints), 3, model.nv))
    select[np.arange(len(joints))[:, None], np.arange(3), dofs[:, None] + np.arange(3)] = 1
    return _limit(
        jacobian=-jnp.sum(axis[:, :, None] * jnp.asarray(select, axis.dtype), axis=1),
        distance=jnp.max(model.jnt_range[joints], axis=1) - angle,
        margin=model.jnt_margin[joints],
        inverse_weight=model.dof_invweight0[dofs],
        solref=model.jnt_solref[joints],
        solimp=model.jnt_solimp[joints],
    )


def _joint_limits(model: mjx.Model, data: mjx.Data) -> Block | None:
    is_scalar = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    joints = np.nonzero(is_scalar & np.asarray(model.jnt_limited, bool))[0]
    if not joints.size:
        return None
    position = data.qpos[model.jnt_qposadr[joints]]
    dofs = model.jnt_dofadr[joints]
    distance, sign = _nearer_end(position, model.jnt_range[joints])
    return _limit(
        jacobian=sign[:, None] * jnp.eye(model.nv, dtype=position.dtype)[dofs],
        distance=distance,
        margin=model.jnt_margin[joints],
        inverse_weight=model.dof_invweight0[dofs],
        solref=model.jnt_solref[joints],
        solimp=model.jnt_solimp[joints],
    )


def _tendon_limits(model: mjx.Model, data: mjx.Data) -> Block | None:
    tendons = np.nonzero(np.asarray(model.tendon_limited, bool))[0]
    if not tendons.size:
        return None
    distance, sign = _nearer_end(data.ten_length[tendons], model.tendon_range[tendons])
    return _limit(
        jacobian=sign[:, None] * data._impl.ten_J[tendons],
        distance=distance,
        margin=model.tendon_margin[tendons],
        inverse_weight=model.tendon_invweight0[tendons],
        solref=model.tendon_solref_lim[tendons],
        solimp=model.tendon_solimp_lim[tendons],
    )


def _nearer_end(
    position: Float[Array, " n"], interval: Float[Array, "n 2"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the distance to the nearer end of an interval, and its derivative's sign."""
    below, above = position - interval[:, 0], interval[:, 1] - position
    is_lower = below < above
    return jnp.where(is_lower, below, above), jnp.where(is_lower, 1.0, -1.0).astype(position.dtype)


def _contacts(model: mjx.Model, data: mjx.Data, dim: int) -> Block | None:
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
        inverse_weight=spread(inverse_weight),
        solref=spread(contact.solref),
        margin=spread(contact.includemargin),
        friction_loss=jnp.zeros_like(residual),
        is_active=residual < 0,
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
        inverse_weight=jnp.concatenate(weights, axis=1).reshape(-1),
        solref=jnp.concatenate(solref, axis=1).reshape(-1, 2),
        margin=spread(contact.includemargin),
        friction_loss=jnp.zeros(count * dim, distance.dtype),
        is_active=spread(distance < 0),
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
    moves = jnp.asarray(_ancestry(model), position.dtype)[bodies]  # contacts, 2, nv
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
    return jnp.sum(wrench[:, :, None, :] * axes, axis=-1)


def _ancestry(model: mjx.Model) -> np.ndarray:
    """Return which joint velocities move which body, (nbody, nv)."""
    moves = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        moves[body] = moves[model.body_parentid[body]]
        first = model.body_dofadr[body]
        moves[body, first : first + model.body_dofnum[body]] = 1
    return moves
