"""Actuation, passive and applied forces, for the models in which they are plain.

Drop-ins for MJX's stages. Whatever a model has beyond actuators of hinges and slides without dynamics, joint springs
and dampers, is left to MJX: each function says what.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import cholesky, kinematics, maps, spatial, tree
from mjxgrad.dynamics.maps import contract, pick

_Disable = mujoco.mjtDisableBit
_Joint = mujoco.mjtJoint
_ON_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_ON_AXES = (_Joint.mjJNT_HINGE, _Joint.mjJNT_SLIDE)
_BIASES = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
# MJX's norm counts as zero where every entry is below this (the absolute tolerance of `allclose`).
_CUT_OFF = 1e-8


def _drives_axes(model: mjx.Model) -> bool:
    """Whether all actuators act on hinges and slides."""
    if not np.isin(model.actuator_trntype, _ON_JOINTS).all():
        return False
    return bool(np.isin(model.jnt_type[model.actuator_trnid[:, 0]], _ON_AXES).all())


def transmission(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Find lengths and moments of actuators; as `mjx.transmission`, to which all but hinges and slides are left."""
    if not model.nu or not _drives_axes(model):
        return mjx.transmission(model, data)
    gear, joint = model.actuator_gear[:, 0], model.actuator_trnid[:, 0]
    drives = (model.jnt_dofadr[joint][:, None] == np.arange(model.nv)).astype(float)
    length = gear * pick(model.jnt_qposadr[joint], data.qpos)
    moment = maps.scale(gear, jnp.asarray(drives, gear.dtype))
    return data.tree_replace({"actuator_length": length, "_impl.actuator_moment": moment})  # pyright: ignore[reportReturnType]


def fwd_velocity(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Find velocities, passive forces and bias forces; a drop-in for `mjx.fwd_velocity`."""
    if model.nu:
        rate = contract("uv,v->u", data._impl.actuator_moment, data.qvel)
        data = data.tree_replace({"_impl.actuator_velocity": rate})  # pyright: ignore[reportAssignmentType]
    if model.ntendon:
        rate = contract("tv,v->t", data._impl.ten_J, data.qvel)
        data = data.tree_replace({"_impl.ten_velocity": rate})  # pyright: ignore[reportAssignmentType]
    data = kinematics.rne(model, passive(model, kinematics.com_vel(model, data)))
    return mjx.tendon_bias(model, data) if model.ntendon else data


def passive(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Find spring and damper forces; a drop-in for `mjx.passive` whose springs have their derivative at rest.

    Tendons, gravity compensation and media are left to MJX.
    """
    flags = model.opt.disableflags
    compensates = model.flg_gravcomp and not flags & _Disable.mjDSBL_GRAVITY
    if model.ntendon or compensates or model.opt._impl.has_fluid_params:
        return _restore_derivative(model, mjx.passive(model, data))
    none = jnp.zeros_like(data.qvel)
    # MJX leaves out both where either is disabled.
    if flags & (_Disable.mjDSBL_SPRING | _Disable.mjDSBL_DAMPER):
        return data.replace(qfrc_passive=none, qfrc_gravcomp=none)
    force = _springs(model, data.qpos) - model.dof_damping * data.qvel
    return data.replace(qfrc_passive=force, qfrc_gravcomp=none)


def _springs(model: mjx.Model, qpos: Float[Array, " nq"]) -> Float[Array, " nv"]:
    forces = []
    for run in tree.joint_runs(model):
        q, rest = qpos[run.qpos], model.qpos_spring[run.qpos]
        stiffness = model.jnt_stiffness[run.joints]
        if run.kind in _ON_AXES:
            forces.append(stiffness * (rest - q))
            continue
        q, rest = q.reshape(-1, run.width), rest.reshape(-1, run.width)
        inverse = spatial.conjugate(rest[:, -4:])
        stretch = spatial.logarithm(spatial.multiply(inverse, q[:, -4:]))
        if run.kind == _Joint.mjJNT_FREE:
            stretch = jnp.concatenate([q[:, :3] - rest[:, :3], stretch], axis=1)
        forces.append(-(stiffness[:, None] * stretch).reshape(-1))
    return jnp.concatenate(forces)


def _restore_derivative(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Return data whose `qfrc_passive` has the derivative of rotational springs at their reference.

    MJX writes the torque of a ball or free joint's spring with a norm that it cuts off near zero, and returns a derivative of
    zero there, as if the spring had gone. The torque itself is zero at the reference, so adding the difference of the analytic
    torque and its own frozen value restores the derivative and leaves the force.
    """
    free = model.jnt_type == _Joint.mjJNT_FREE
    joints = np.nonzero(free | (model.jnt_type == _Joint.mjJNT_BALL))[0]
    if not joints.size or model.opt.disableflags & (_Disable.mjDSBL_SPRING | _Disable.mjDSBL_DAMPER):
        return data
    addresses = (model.jnt_qposadr + 3 * free)[joints][:, None] + np.arange(4)
    dofs = (model.jnt_dofadr + 3 * free)[joints][:, None] + np.arange(3)
    turn = spatial.multiply(spatial.conjugate(model.qpos_spring[addresses]), data.qpos[addresses])
    torque = -model.jnt_stiffness[joints][:, None] * spatial.logarithm(turn)
    is_cut = jnp.all(jnp.abs(turn[:, 1:]) <= _CUT_OFF, axis=1, keepdims=True)
    missing = jnp.where(is_cut, torque - jax.lax.stop_gradient(torque), 0.0)
    return data.replace(qfrc_passive=data.qfrc_passive.at[dofs].add(missing))


def fwd_actuation(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Find actuator forces; a drop-in for `mjx.fwd_actuation`.

    For motors and servos without activation dynamics on hinges and slides; other actuators are left to MJX.
    """
    if not model.nu or model.opt.disableflags & _Disable.mjDSBL_ACTUATION or not _is_plain(model):
        return mjx.fwd_actuation(model, data)
    control = data.ctrl
    if not model.opt.disableflags & _Disable.mjDSBL_CLAMPCTRL:
        control = _clamp(control, model.actuator_ctrllimited, model.actuator_ctrlrange)
    force = model.actuator_gainprm[:, 0] * control
    is_servo = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    if is_servo.any():
        constant, on_length, on_velocity = model.actuator_biasprm[:, :3].T
        bias = constant + on_length * data.actuator_length
        force += jnp.where(is_servo, bias + on_velocity * data._impl.actuator_velocity, 0.0)
    force = _clamp(force, model.actuator_forcelimited, model.actuator_forcerange)
    total = contract("uv,u->v", data._impl.actuator_moment, force)
    limited = model.jnt_actfrclimited
    if limited.any():
        bounds = pick(model.dof_jntid, model.jnt_actfrcrange)
        total = _clamp(total, limited[model.dof_jntid], bounds)
    return data.replace(act_dot=jnp.zeros_like(data.act), actuator_force=force, qfrc_actuator=total)


def _is_plain(model: mjx.Model) -> bool:
    """Whether forces are those of motors or servos without dynamics."""
    return bool(
        not model.na
        and not model.flg_gravcomp
        and not np.any(model.tendon_actfrclimited)
        and _drives_axes(model)
        and (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
        and np.isin(model.actuator_biastype, _BIASES).all()
    )


def _clamp(x: Float[Array, " n"], is_limited: np.ndarray, bounds: Float[Array, "n 2"]) -> Float[Array, " n"]:
    if not is_limited.any():
        return x
    return jnp.where(is_limited, jnp.clip(x, bounds[:, 0], bounds[:, 1]), x)


def fwd_acceleration(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Add up all forces but those of constraints; a drop-in for `mjx.fwd_acceleration`.

    `xfrc_applied` acts at the bodies' centres of mass (N, N m). Derivatives go through the bodies, not through the entries of M.
    """
    push, torque = data.xfrc_applied[:, :3], data.xfrc_applied[:, 3:]
    lever = data.xipos - pick(model.body_rootid, data.subtree_com)
    wrench = jnp.concatenate([torque + spatial.cross(lever, push), push], axis=1)
    applied = data.qfrc_applied + kinematics.generalised_force(model, data, wrench)
    total = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + applied
    unconstrained = cholesky.solve_positive_definite(kinematics.inertia_of(model, data), total)
    return data.replace(qfrc_smooth=total, qacc_smooth=unconstrained)
