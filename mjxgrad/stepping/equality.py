"""Constraint rows of equality constraints: connect, weld, joint and tendon couplings, in MuJoCo's order.

Connect and weld subtract the drift J̇ v, the relative acceleration of moving bodies without joint accelerations. MJX lacks it.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.batched import maps
from mjxgrad.batched.maps import safe_norm
from mjxgrad.bodies import kinematics, spatial, tree
from mjxgrad.contact.law import impedance
from mjxgrad.solver.jacobian import DenseRows
from mjxgrad.stepping.rows import Block, contact_jacobian

_Column = Float[Array, " n"]
_Ends = Float[Array, "constraints 2 3"]


def blocks(model: mjx.Model, data: mjx.Data) -> list[Block | None]:
    """Return one block per type of equality constraint in the model."""
    kinds, found = mujoco.mjtEq, []
    of_kinds = {
        kinds.mjEQ_CONNECT: _connect,
        kinds.mjEQ_WELD: _weld,
        kinds.mjEQ_JOINT: _coupling,
        kinds.mjEQ_TENDON: _coupling,
    }
    for kind, rows in of_kinds.items():
        if (ids := np.nonzero(model.eq_type == kind)[0]).size:
            found.append(rows(model, data, ids))
    return found


def _block(
    model: mjx.Model,
    data: mjx.Data,
    ids: np.ndarray,
    jacobian: Float[Array, "constraints k nv"],
    residual: Float[Array, "constraints k"],
    inverse_weight: Float[Array, "constraints k"],
    drift: Float[Array, "constraints k"] | None = None,
) -> Block:
    """Return the block of constraints with k rows each; their impedance is that of the residual's norm."""
    spread = functools.partial(jnp.repeat, repeats=residual.shape[1], axis=0)
    flat = residual.reshape(-1)
    zero = jnp.zeros_like(flat)
    return Block(
        map=DenseRows(jacobian.reshape(flat.size, 1, -1)),
        residual=flat,
        impedance=jax.tree.map(spread, impedance(model.eq_solimp[ids], safe_norm(residual))),
        solimp=spread(model.eq_solimp[ids]),
        inverse_weight=inverse_weight.reshape(-1),
        solref=spread(model.eq_solref[ids]),
        margin=zero,
        friction_loss=zero,
        is_active=spread(jnp.asarray(data.eq_active)[ids] != 0),
        drift=None if drift is None else drift.reshape(-1),
    )


def _ends(model: mjx.Model, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    is_site = np.asarray(model.eq_objtype)[ids] == mujoco.mjtObj.mjOBJ_SITE
    objects = np.stack([model.eq_obj1id[ids], model.eq_obj2id[ids]], axis=1)
    bodies = objects.copy()
    if is_site.any():
        bodies[is_site] = np.asarray(model.site_bodyid)[objects[is_site]]
    return is_site, objects, bodies


def _points(model: mjx.Model, data: mjx.Data, ids: np.ndarray, anchors: _Ends) -> _Ends:
    is_site, objects, bodies = _ends(model, ids)
    points = data.xpos[bodies] + jnp.sum(data.xmat[bodies] * anchors[:, :, None, :], axis=-1)
    if is_site.any():
        sites = data.site_xpos[np.where(is_site[:, None], objects, 0)]
        points = jnp.where(is_site[:, None, None], sites, points)
    return points


def _translation(
    model: mjx.Model, data: mjx.Data, points: _Ends, bodies: np.ndarray
) -> Float[Array, "constraints 3 nv"]:
    frame = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), (len(points), 3, 3))
    world = np.zeros_like(bodies[:, 0])
    first, second = (
        contact_jacobian(model, data, points[:, end], frame, np.stack([world, bodies[:, end]], 1), 3) for end in (0, 1)
    )
    return first - second


def _accelerations(model: mjx.Model, data: mjx.Data, points: _Ends, bodies: np.ndarray) -> tuple[_Ends, _Ends, _Ends]:
    """Return angular velocities, angular accelerations and accelerations of both ends without joint accelerations."""
    data = kinematics.com_vel(model, data)
    of_bodies = maps.combine(tree.moving_dofs(model), maps.scale(data.qvel, data.cdof_dot))
    lever = points - data.subtree_com[model.body_rootid[bodies]]
    spin, speed = jnp.split(data.cvel[bodies], 2, axis=-1)
    angular, linear = jnp.split(of_bodies[bodies], 2, axis=-1)
    speed = speed + jnp.cross(spin, lever)
    return spin, angular, linear + jnp.cross(angular, lever) + jnp.cross(spin, speed)


def _connect(model: mjx.Model, data: mjx.Data, ids: np.ndarray) -> Block:
    points = _points(model, data, ids, model.eq_data[ids][:, :6].reshape(-1, 2, 3))
    bodies = _ends(model, ids)[2]
    weight = jnp.repeat(jnp.sum(model.body_invweight0[bodies, 0], axis=1)[:, None], 3, axis=1)
    moved = _accelerations(model, data, points, bodies)[2]
    jacobian, residual = _translation(model, data, points, bodies), points[:, 0] - points[:, 1]
    return _block(model, data, ids, jacobian, residual, weight, moved[:, 0] - moved[:, 1])


def _weld(model: mjx.Model, data: mjx.Data, ids: np.ndarray) -> Block:
    """Return six rows: difference of position, and the vector part of the relative quaternion times the torque scale."""
    settings = model.eq_data[ids]
    is_site, objects, bodies = _ends(model, ids)
    # The data of a weld hold the second body's anchor first.
    points = _points(model, data, ids, settings[:, :6].reshape(-1, 2, 3)[:, ::-1])
    scale = settings[:, 10:11]
    first = spatial.multiply(data.xquat[bodies[:, 0]], settings[:, 6:10])
    second = data.xquat[bodies[:, 1]]
    if is_site.any():
        quaternions = model.site_quat[np.where(is_site[:, None], objects, 0)]
        of_sites = spatial.multiply(data.xquat[bodies], quaternions)
        first = jnp.where(is_site[:, None], of_sites[:, 0], first)
        second = jnp.where(is_site[:, None], of_sites[:, 1], second)
    back = spatial.conjugate(second)
    error = spatial.multiply(back, first)[:, 1:] * scale
    moves = tree.moving_dofs(model)
    sign = jnp.asarray(moves[bodies[:, 0]] - moves[bodies[:, 1]], data.cdof.dtype)
    turning = sign[:, :, None] * data.cdof[:, :3]  # constraints, nv, 3
    axis = jnp.concatenate([jnp.zeros_like(turning[..., :1]), turning], axis=-1)
    rate = spatial.multiply(spatial.multiply(back[:, None], axis), first[:, None])[..., 1:]
    rate = 0.5 * scale[:, :, None] * jnp.swapaxes(rate, 1, 2)
    weight = jnp.sum(model.body_invweight0[bodies], axis=1)  # translation, rotation
    spin, angular, moved = _accelerations(model, data, points, bodies)
    # With q' = ω q / 2 the rate of q₂* q₁ is q₂* (ω₁ - ω₂) q₁ / 2; its rate gives the drift:
    own, other, change = (jnp.pad(x, ((0, 0), (1, 0))) for x in (spin[:, 0], spin[:, 1], angular[:, 0] - angular[:, 1]))
    change += 0.5 * (spatial.multiply(own - other, own) - spatial.multiply(other, own - other))
    twist = 0.5 * scale * spatial.multiply(spatial.multiply(back, change), first)[:, 1:]
    drift = jnp.concatenate([moved[:, 0] - moved[:, 1], twist], axis=1)
    jacobian = jnp.concatenate([_translation(model, data, points, bodies), rate], axis=1)
    residual = jnp.concatenate([points[:, 0] - points[:, 1], error], axis=1)
    return _block(model, data, ids, jacobian, residual, jnp.repeat(weight, 3, axis=1), drift)


def _polynomial(coefficients: Float[Array, "n 5"], x: _Column) -> tuple[_Column, _Column]:
    """Return a quartic and its derivative by Horner's rule, without powers of zero, which have no derivative."""
    value, slope = coefficients[:, 4], jnp.zeros_like(x)
    for k in (3, 2, 1, 0):
        slope = slope * x + value
        value = value * x + coefficients[:, k]
    return value, slope


def _coupling(model: mjx.Model, data: mjx.Data, ids: np.ndarray) -> Block:
    """Return rows x₁ - p(x₂) for pairs of joints or tendons; without a second one x₂ = 0."""
    places = dofs = (model.eq_obj1id[ids], model.eq_obj2id[ids])
    if model.eq_type[ids[0]] == mujoco.mjtEq.mjEQ_TENDON:
        present, rest, weights = data.ten_length, model.tendon_length0, model.tendon_invweight0
        entries = data._impl.ten_J
    else:
        places, dofs = ([table[joint] for joint in places] for table in (model.jnt_qposadr, model.jnt_dofadr))
        present, rest, weights = data.qpos, model.qpos0, model.dof_invweight0
        entries = jnp.eye(model.nv, dtype=data.qpos.dtype)
    first, second = (present[place] - rest[place] for place in places)
    has_second = jnp.asarray(model.eq_obj2id[ids] >= 0, data.qpos.dtype)
    value, slope = _polynomial(model.eq_data[ids][:, :5], second * has_second)
    row = entries[dofs[0]] - (slope * has_second)[:, None] * entries[dofs[1]]
    weight = (weights[dofs[0]] + weights[dofs[1]] * has_second)[:, None]
    return _block(model, data, ids, row[:, None], (first - value)[:, None], weight)
