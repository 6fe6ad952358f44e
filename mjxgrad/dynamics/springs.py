"""Rotational springs at their reference, where MJX's force is right and its derivative is missing.

MJX writes the torque of a ball or free joint's spring with a norm that it cuts off near zero, and returns a derivative of zero
there, as if the spring had gone. The torque itself is zero at the reference, so adding the difference of the analytic torque
and its own frozen value restores the derivative and leaves the force.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import rotation

# MJX's norm counts as zero where every entry is below this (the absolute tolerance of `allclose`).
_CUT_OFF = 1e-8


def restore_derivative(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Return data whose `qfrc_passive` has the derivative of rotational springs at their reference."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    joints = np.nonzero(free | (model.jnt_type == mujoco.mjtJoint.mjJNT_BALL))[0]
    off = mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER
    if not joints.size or model.opt.disableflags & off:
        return data
    addresses = (model.jnt_qposadr + 3 * free)[joints][:, None] + np.arange(4)
    dofs = (model.jnt_dofadr + 3 * free)[joints][:, None] + np.arange(3)
    turn = rotation.multiply(rotation.conjugate(model.qpos_spring[addresses]), data.qpos[addresses])
    torque = -model.jnt_stiffness[joints][:, None] * rotation.logarithm(turn)
    is_cut = jnp.all(jnp.abs(turn[:, 1:]) <= _CUT_OFF, axis=1, keepdims=True)
    missing = jnp.where(is_cut, torque - jax.lax.stop_gradient(torque), 0.0)
    return data.replace(qfrc_passive=data.qfrc_passive.at[dofs].add(missing))
