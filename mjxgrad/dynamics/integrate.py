"""Positions moved along velocities, joint by joint."""

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import rotation, spatial


def integrate_position(
    model: mjx.Model,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    duration: Float[Array, ""] | float,
) -> Float[Array, " nq"]:
    """Return the position after moving at constant joint velocity; quaternions turn in their own frame.

    Args:
        model: gives the joints.
        qpos: the position to start from (m, rad, unit quaternions).
        qvel: joint velocities (m/s, rad/s).
        duration: how long (s).
    """
    turning, first, dofs = _addresses(model)
    if not turning.size:
        return qpos + duration * qvel
    moved = qpos.at[first].add(duration * qvel[dofs])
    quaternions = qpos[turning[:, :1] + np.arange(4)]
    turned = rotation.integrate(quaternions, duration * qvel[turning[:, 1:] + np.arange(3)])
    return moved.at[turning[:, :1] + np.arange(4)].set(turned)


def position_change(model: mjx.Model, start: Float[Array, " nq"], end: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Return the velocity that moves one position to another in unit time; the inverse of `integrate_position`.

    Args:
        model: gives the joints.
        start: a position (m, rad, unit quaternions).
        end: another; of the two turns between quaternions the shorter is taken.
    """
    turning, first, dofs = _addresses(model)
    if not turning.size:
        return end - start
    quaternions = turning[:, :1] + np.arange(4)
    turned = rotation.logarithm(spatial.multiply(rotation.conjugate(start[quaternions]), end[quaternions]))
    change = jnp.zeros(model.nv, start.dtype).at[dofs].set((end - start)[first])
    return change.at[turning[:, 1:] + np.arange(3)].set(turned)


def _addresses(model: mjx.Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (qpos, dof) addresses of quaternions, and those of the coordinates that simply add."""
    turning, first, dofs = [], [], []
    for kind, address, dof in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            first += range(address, address + 3)
            dofs += range(dof, dof + 3)
            turning.append((address + 3, dof + 3))
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            turning.append((address, dof))
        else:
            first.append(address)
            dofs.append(dof)
    return np.array(turning, int).reshape(-1, 2), np.array(first, int), np.array(dofs, int)
