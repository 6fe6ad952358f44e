r"""Kinematics, inertia and bias forces: the smooth stages of a step, without recursion.

MuJoCo expresses all spatial quantities of a kinematic tree about one point, the tree's centre of mass, in world axes. So the
usual recursion over the tree becomes a sum over ancestors or descendants: a product with a constant 0/1 matrix. Only orientations
multiply, see `orientation`. The stages fill the same fields of `mjx.Data` with the same values as MJX, whose walk over the tree
is slow in reverse mode. One difference is intended: bodies fixed to a mocap body follow it, as in C MuJoCo.

References:
    Featherstone. Rigid Body Dynamics Algorithms. Springer 2008, chapters 5 and 6.
    MuJoCo documentation, "Computation", "General framework".
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjxgrad._mjx import mjx
from mjxgrad.batched import maps
from mjxgrad.batched.maps import combine, contract, pick
from mjxgrad.bodies import mended, spatial, tree
from mjxgrad.bodies.orientation import Orientations

_Position = Float[Array, " nq"]
_Vector = Float[Array, " nv"]
_Duration = Float[Array, ""] | float
_Joint = mujoco.mjtJoint
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_UP = np.array([0.0, 0.0, 1.0])


def up_to_inertia(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Run the stages from the position to the mass matrix; the stages of tendons are MJX's."""
    data = com_pos(model, kinematics(model, data))
    if not model.ntendon:
        return crb(model, data)
    return mended.tendon_armature(model, crb(model, mended.tendon(model, data)))


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Place bodies, joints, geoms and sites, and normalise the quaternions of `qpos`; a drop-in for `mjx.kinematics`."""
    frames = tree.frames(model)
    qpos, turn, way, origin = _joint_motion(model, data.qpos)
    turned = Orientations.of(model, data, frames, turn)
    fixed = spatial.rotation_matrix(pick(np.where(frames.is_first, model.jnt_bodyid, -1), model.body_quat, _IDENTITY))
    is_free = (model.jnt_type == _Joint.mjJNT_FREE)[:, None]
    axis = jnp.where(is_free, jnp.asarray(_UP, qpos.dtype), spatial.rotate(fixed, model.jnt_axis))
    before = np.concatenate([frames.before_body, frames.before_joint, frames.before_joint])
    local = jnp.concatenate([model.body_pos, spatial.rotate(fixed, model.jnt_pos), axis])
    from_parent, to_anchor, axis = jnp.split(turned.rotate(before, local), [model.nbody, model.nbody + model.njnt])
    if model.nmocap:
        is_mocap = (model.body_mocapid >= 0)[:, None]
        from_parent = jnp.where(is_mocap, pick(model.body_mocapid, data.mocap_pos), from_parent)
    moved = origin + maps.scale(way, axis)
    moved -= turned.rotate(frames.after_joint, model.jnt_pos * (frames.after_joint >= 0)[:, None])
    of_bodies, of_anchors = tree.displacements(model)
    steps = jnp.concatenate([from_parent, to_anchor, moved])
    positions = combine(np.concatenate([of_bodies, of_anchors]), steps)
    xpos, xanchor = positions[: model.nbody], positions[model.nbody :]

    def place(body: np.ndarray, pos: Array, quat: Array) -> tuple[Array, Array]:
        """Return world positions and orientations of frames fixed to bodies."""
        last = frames.of_body[body]
        return pick(body, xpos) + turned.rotate(last, pos), turned.compose(last, spatial.rotation_matrix(quat))

    xmat = turned.compose(frames.of_body, jnp.broadcast_to(jnp.eye(3, dtype=xpos.dtype), (model.nbody, 3, 3)))
    xquat = turned.quaternions(frames.of_body)
    xipos, ximat = place(np.arange(model.nbody), model.body_ipos, model.body_iquat)
    data = data.replace(qpos=qpos, xanchor=xanchor, xaxis=axis, xpos=xpos, xquat=xquat, xmat=xmat)
    data = data.replace(xipos=xipos, ximat=ximat)
    if model.ngeom:
        placed = place(model.geom_bodyid, model.geom_pos, model.geom_quat)
        data = data.replace(geom_xpos=placed[0], geom_xmat=placed[1])
    if model.nsite:
        placed = place(model.site_bodyid, model.site_pos, model.site_quat)
        data = data.replace(site_xpos=placed[0], site_xmat=placed[1])
    return data


def _joint_motion(
    model: mjx.Model, qpos: _Position
) -> tuple[_Position, Float[Array, "njnt 4"], Float[Array, " njnt"], Float[Array, "njnt 3"]]:
    """Return normalised positions and each joint's quaternion, displacement along its axis, and position if free."""
    dtype = qpos.dtype
    parts = []
    for run in tree.joint_runs(model):
        q, count = qpos[run.qpos], run.joints.stop - run.joints.start
        turn = jnp.asarray(np.tile(_IDENTITY, (count, 1)), dtype)
        way, origin = jnp.zeros(count, dtype), jnp.zeros((count, 3), dtype)
        if run.kind == _Joint.mjJNT_SLIDE:
            way = q - model.qpos0[run.qpos]
        elif run.kind == _Joint.mjJNT_HINGE:
            half = 0.5 * (q - model.qpos0[run.qpos])
            axes = model.jnt_axis[run.joints]
            turn = jnp.concatenate([jnp.cos(half)[:, None], maps.scale(jnp.sin(half), axes)], axis=1)
        else:
            q = q.reshape(count, run.width)
            turn = spatial.normalise(q[:, -4:])
            if run.kind == _Joint.mjJNT_FREE:
                origin = q[:, :3]
                q = jnp.concatenate([origin, turn], axis=1).reshape(-1)
            else:
                q = turn.reshape(-1)
        parts.append((q, turn, way, origin))
    if not parts:
        return qpos, *(jnp.zeros((0, *shape), dtype) for shape in ((4,), (), (3,)))  # pyright: ignore[reportReturnType]
    return tuple(jnp.concatenate(x) for x in zip(*parts, strict=True))  # pyright: ignore[reportReturnType]


def com_pos(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute `subtree_com`, `cinert` and `cdof`, also of massless bodies; a drop-in for `mjx.com_pos`."""
    mass = model.body_mass
    moments = jnp.concatenate([maps.scale(mass, data.xipos), mass[:, None]], axis=1)
    sums = combine(tree.descendants(model), moments)
    is_massless = sums[:, 3:] < mujoco.mjMINVAL
    centre = sums[:, :3] / jnp.where(is_massless, 1.0, sums[:, 3:])
    centre = jnp.where(is_massless, data.xipos, centre)
    offset = data.xipos - pick(model.body_rootid, centre)
    central = spatial.compose(data.ximat * model.body_inertia[:, None], data.ximat.transpose(0, 2, 1))
    inertia = spatial.inertia_about(offset, mass, central)
    return data.tree_replace({"subtree_com": centre, "_impl.cinert": inertia, "cdof": _joint_axes(model, data, centre)})  # pyright: ignore[reportReturnType]


def _joint_axes(model: mjx.Model, data: mjx.Data, centre: Float[Array, "nbody 3"]) -> Float[Array, "nv 6"]:
    """Return the motions of unit joint velocities about the centre of mass of their tree."""
    angular, linear = [], []
    for run in tree.joint_runs(model):
        axis = data.xaxis[run.joints]
        if run.kind in (_Joint.mjJNT_FREE, _Joint.mjJNT_BALL):
            axis = pick(model.jnt_bodyid[run.joints], data.xmat).transpose(0, 2, 1)
        still = jnp.zeros_like(axis)
        if run.kind == _Joint.mjJNT_FREE:
            along = jnp.broadcast_to(jnp.eye(3, dtype=axis.dtype), axis.shape)
            turning, moving = jnp.concatenate([still, axis], 1), jnp.concatenate([along, still], 1)
        else:
            turning, moving = (still, axis) if run.kind == _Joint.mjJNT_SLIDE else (axis, still)
        angular.append(turning.reshape(-1, 3))
        linear.append(moving.reshape(-1, 3))
    if not angular:
        return jnp.zeros((0, 6), data.qpos.dtype)
    turning = jnp.concatenate(angular)
    root = pick(model.body_rootid[model.dof_bodyid], centre)
    lever = root - pick(model.dof_jntid, data.xanchor)
    return jnp.concatenate([turning, jnp.concatenate(linear) + spatial.cross(turning, lever)], axis=1)


def com_vel(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute body velocities `cvel` and rates of joint axes `cdof_dot`; a drop-in for `mjx.com_vel`."""
    motion = maps.scale(data.qvel, data.cdof)
    sums = combine(np.concatenate([tree.moving_dofs(model), tree.earlier_dofs(model)]), motion)
    velocity, before = sums[: model.nbody], sums[model.nbody :]
    return data.replace(cvel=velocity, cdof_dot=spatial.cross_motion(before, data.cdof))


def crb(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute the mass matrix from composite inertias; a drop-in for `mjx.crb`."""
    # M_ij = cdof_i · I_i cdof_j, with I_i the inertia of all bodies that joint i carries, for j an ancestor of i or i
    # itself. `M` keeps the format of the data, either of MJX's two.
    if data._impl.M.ndim == 1:
        return mjx.crb(model, data)
    below = tree.descendants(model)
    below[0] = 0
    carried = combine(below[model.dof_bodyid], data._impl.cinert)
    momentum = spatial.momentum(carried, data.cdof)
    products = contract("ik,jk->ij", momentum, data.cdof)
    is_pair = np.zeros((model.nv, model.nv))
    is_pair[np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind] = 1
    lower = products * jnp.asarray(is_pair, products.dtype)
    mirrored = products.T * jnp.asarray(np.triu(is_pair.T, 1), products.dtype)
    diagonal = model.dof_armature[:, None] * jnp.eye(model.nv, dtype=products.dtype)
    return data.tree_replace({"_impl.crb": combine(below, data._impl.cinert), "_impl.M": lower + mirrored + diagonal})  # pyright: ignore[reportReturnType]


def rne(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute gravity, Coriolis and centrifugal forces, `qfrc_bias`; a drop-in for `mjx.rne`."""
    acceleration = combine(tree.moving_dofs(model), maps.scale(data.qvel, data.cdof_dot))
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        upwards = -jnp.asarray(model.opt.gravity, acceleration.dtype)
        acceleration += jnp.concatenate([jnp.zeros_like(upwards), upwards])
    inertia = data._impl.cinert
    rate = spatial.cross_force(data.cvel, spatial.momentum(inertia, data.cvel))
    force = spatial.momentum(inertia, acceleration) + rate
    return data.replace(qfrc_bias=generalised_force(model, data, force))


def generalised_force(model: mjx.Model, data: mjx.Data, force: Float[Array, "nbody 6"]) -> _Vector:
    """Return the joint forces equivalent to forces on bodies, given about the centre of mass of their tree."""
    carried = combine(tree.moving_dofs(model).T, force)
    return maps.dot(data.cdof, carried)


class Inertia(eqx.Module):
    """The mass matrix M: its entries and, unless tendons add to it, its bodies, through which derivatives go."""

    # By bodies M a is computed as in `rne`: sums over ancestors give the bodies' accelerations, their inertias the forces, and
    # sums over descendants the joint forces. The derivative has the same form.
    matrix: Float[Array, "nv nv *batch"]
    bodies: Float[Array, "nbody 10 *batch"] | None = None
    axes: Float[Array, "nv 6 *batch"] | None = None
    armature: Float[Array, "nv *batch"] | None = None
    moves: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())  # of `tree.moving_dofs`

    def apply(self, acceleration: _Vector) -> _Vector:
        if self.bodies is None or self.axes is None or self.armature is None:
            return contract("ij,j->i", self.matrix, acceleration)
        moves = np.array(self.moves)
        motion = combine(moves, maps.scale(acceleration, self.axes))
        force = spatial.momentum(self.bodies, motion)
        return maps.dot(self.axes, combine(moves.T, force)) + self.armature * acceleration

    def plus(self, diagonal: _Vector) -> "Inertia":
        armature = None if self.armature is None else self.armature + diagonal
        return dataclasses.replace(self, matrix=self.matrix + jnp.diag(diagonal), armature=armature)


def inertia_of(model: mjx.Model, data: mjx.Data) -> Inertia:
    """Return M of data whose mass matrix is filled in."""
    matrix = mjx.full_m(model, data)
    if model.ntendon or data._impl.M.ndim == 1:
        # The armature of tendons is not that of bodies, and the sparse format is MJX's.
        return Inertia(matrix)
    moves = tuple(map(tuple, tree.moving_dofs(model).tolist()))
    armature = jnp.asarray(model.dof_armature, matrix.dtype)
    return Inertia(matrix, data._impl.cinert, data.cdof, armature, moves)


def integrate_position(
    model: mjx.Model | mujoco.MjModel, qpos: _Position, qvel: _Vector, duration: _Duration
) -> _Position:
    """Return the position after a duration (s) at constant joint velocity; quaternions turn in their own frame."""
    parts = []
    for run in tree.joint_runs(model):
        q, change = qpos[run.qpos].reshape(-1, run.width), duration * qvel[run.dofs]
        if run.width > 1:
            change = change.reshape(len(q), -1)
            turned = spatial.normalise(spatial.multiply(q[:, -4:], spatial.exponential(change[:, -3:])))
            parts.append(jnp.concatenate([q[:, :-4] + change[:, :-3], turned], axis=1).reshape(-1))
        else:
            parts.append(q[:, 0] + change)
    return jnp.concatenate(parts)


def position_change(model: mjx.Model | mujoco.MjModel, start: _Position, end: _Position) -> _Vector:
    """Return the velocity that moves one position to another in unit time; quaternions, of any length, take the shorter turn."""
    # The inverse of `integrate_position`.
    parts = []
    for run in tree.joint_runs(model):
        before, after = (x[run.qpos].reshape(-1, run.width) for x in (start, end))
        change = after - before
        if run.width > 1:
            turn = spatial.multiply(spatial.conjugate(before[:, -4:]), after[:, -4:])
            change = jnp.concatenate([change[:, :-4], spatial.logarithm(spatial.normalise(turn))], axis=1)
        parts.append(change.reshape(-1))
    return jnp.concatenate(parts)
