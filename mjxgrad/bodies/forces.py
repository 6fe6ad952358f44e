"""Actuation, passive and applied forces of common models: drop-ins for MJX's stages, which say what they leave to MJX."""

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import compensate_gravity, fluid_force, mjx
from mjxgrad.batched import cholesky, maps
from mjxgrad.batched.maps import contract, pick
from mjxgrad.bodies import kinematics, mended, spatial

_Disable = mujoco.mjtDisableBit
_Joint = mujoco.mjtJoint
_ON_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_ON_AXES = (_Joint.mjJNT_HINGE, _Joint.mjJNT_SLIDE)
_BIASES = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)


def _drives_axes(model: mjx.Model) -> bool:
    if not np.isin(model.actuator_trntype, _ON_JOINTS).all():
        return False
    return bool(np.isin(model.jnt_type[model.actuator_trnid[:, 0]], _ON_AXES).all())


def transmission(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute lengths and moments of actuators; a drop-in for `mjx.transmission`, which takes all but hinges and slides."""
    if not model.nu or not _drives_axes(model):
        return mended.transmission(model, data)
    gear, joint = model.actuator_gear[:, 0], model.actuator_trnid[:, 0]
    drives = (model.jnt_dofadr[joint][:, None] == np.arange(model.nv)).astype(float)
    length = gear * pick(model.jnt_qposadr[joint], data.qpos)
    moment = maps.scale(gear, jnp.asarray(drives, gear.dtype))
    return data.tree_replace({"actuator_length": length, "_impl.actuator_moment": moment})  # pyright: ignore[reportReturnType]


def fwd_velocity(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute velocities, passive forces and bias forces; a drop-in for `mjx.fwd_velocity`."""
    if model.nu:
        rate = contract("uv,v->u", data._impl.actuator_moment, data.qvel)
        data = data.tree_replace({"_impl.actuator_velocity": rate})  # pyright: ignore[reportAssignmentType]
    if model.ntendon:
        rate = contract("tv,v->t", data._impl.ten_J, data.qvel)
        data = data.tree_replace({"_impl.ten_velocity": rate})  # pyright: ignore[reportAssignmentType]
    data = kinematics.rne(model, passive(model, kinematics.com_vel(model, data)))
    return mended.tendon_bias(model, data) if model.ntendon else data


def passive(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute spring and damper forces; a drop-in for `mjx.passive` whose springs are differentiable at rest."""
    # Gravity compensation and media are left to MJX.
    flags = model.opt.disableflags
    none = jnp.zeros_like(data.qvel)
    # MJX drops all passive forces where either is disabled.
    if flags & (_Disable.mjDSBL_SPRING | _Disable.mjDSBL_DAMPER):
        return data.replace(qfrc_passive=none, qfrc_gravcomp=none)
    stretch = kinematics.position_change(model, model.qpos_spring, data.qpos)
    force = -pick(model.dof_jntid, model.jnt_stiffness) * stretch - model.dof_damping * data.qvel
    if model.ntendon:
        force += contract("tv,t->v", data._impl.ten_J, _tendon_forces(model, data))
    compensation = none
    if model.flg_gravcomp and not flags & _Disable.mjDSBL_GRAVITY:
        compensation = compensate_gravity(model, data)
        force += compensation * (1 - model.jnt_actgravcomp[model.dof_jntid])
    if model.opt._impl.has_fluid_params:
        force += fluid_force(model, data)
    return data.replace(qfrc_passive=force, qfrc_gravcomp=compensation)


def _tendon_forces(model: mjx.Model, data: mjx.Data) -> Float[Array, " tendons"]:
    """Return spring and damper forces; at an end of the slack interval the derivative is that of the stretched side."""
    shortest, longest = model.tendon_lengthspring.T
    # MJX compares strictly: with equal ends a spring at rest would have no stiffness.
    stretch = jnp.where(data.ten_length <= shortest, data.ten_length - shortest, 0.0)
    stretch = jnp.where(data.ten_length >= longest, data.ten_length - longest, stretch)
    return -model.tendon_stiffness * stretch - model.tendon_damping * data._impl.ten_velocity


def fwd_actuation(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute actuator forces; a drop-in for `mjx.fwd_actuation`."""
    # It computes motors and servos without activation dynamics on hinges and slides; other actuators are left to MJX.
    if not model.nu or model.opt.disableflags & _Disable.mjDSBL_ACTUATION:
        return mended.fwd_actuation(model, data)
    if not _is_plain(model):
        find = _with_tendon_limits if np.any(model.tendon_actfrclimited) else mended.fwd_actuation
        return find(model, data)
    control = data.ctrl
    if not model.opt.disableflags & _Disable.mjDSBL_CLAMPCTRL:
        control = _clamp(control, model.actuator_ctrllimited, model.actuator_ctrlrange)
    force = model.actuator_gainprm[:, 0] * control
    is_servo = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    if is_servo.any():
        constant, on_length, on_velocity = model.actuator_biasprm[:, :3].T
        bias = constant + on_length * data.actuator_length
        force += jnp.where(is_servo, bias + on_velocity * data._impl.actuator_velocity, 0.0)
    return _actuated(model, data.replace(act_dot=jnp.zeros_like(data.act)), force)


def _with_tendon_limits(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute forces under limits on the sum per tendon; MJX divides by that sum even where it is zero."""
    tendons = np.flatnonzero(model.tendon_actfrclimited)
    limits = ("tendon_actfrclimited", "actuator_forcelimited")
    data = mended.fwd_actuation(model.replace(**{x: np.zeros_like(getattr(model, x)) for x in limits}), data)
    pulls = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON) & (model.actuator_trnid[:, 0] == tendons[:, None])
    total = contract("tu,u->t", jnp.asarray(pulls, data.actuator_force.dtype), data.actuator_force)
    least, most = model.tendon_actfrcrange[tendons].T
    is_within = (total >= least) & (total <= most)
    share = jnp.where(is_within, 1.0, jnp.clip(total, least, most) / jnp.where(is_within, 1.0, total))
    force = data.actuator_force * jnp.prod(jnp.where(pulls, share[:, None], 1.0), axis=0)
    return _actuated(model, data, force)


def _actuated(model: mjx.Model, data: mjx.Data, force: Float[Array, " nu"]) -> mjx.Data:
    force = _clamp(force, model.actuator_forcelimited, model.actuator_forcerange)
    total = contract("uv,u->v", data._impl.actuator_moment, force)
    if model.flg_gravcomp:
        total += data.qfrc_gravcomp * model.jnt_actgravcomp[model.dof_jntid]
    limited = model.jnt_actfrclimited
    if limited.any():
        bounds = pick(model.dof_jntid, model.jnt_actfrcrange)
        total = _clamp(total, limited[model.dof_jntid], bounds)
    return data.replace(actuator_force=force, qfrc_actuator=total)


def _is_plain(model: mjx.Model) -> bool:
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
    """Sum all forces but those of constraints; a drop-in for `mjx.fwd_acceleration`."""
    # `xfrc_applied` acts at the bodies' centres of mass (N, N m). Derivatives go through the bodies, not through the
    # entries of M.
    push, torque = data.xfrc_applied[:, :3], data.xfrc_applied[:, 3:]
    lever = data.xipos - pick(model.body_rootid, data.subtree_com)
    wrench = jnp.concatenate([torque + spatial.cross(lever, push), push], axis=1)
    applied = data.qfrc_applied + kinematics.generalised_force(model, data, wrench)
    total = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + applied
    unconstrained = cholesky.solve_positive_definite(kinematics.inertia_of(model, data), total)
    return data.replace(qfrc_smooth=total, qacc_smooth=unconstrained)
