"""The kinematic tree of a model as constant arrays.

Only static fields of the model are read, so lengths, masses and axes may be traced.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mjxgrad._mjx import mjx

_FREE = mujoco.mjtJoint.mjJNT_FREE
_BALL = mujoco.mjtJoint.mjJNT_BALL
_SLIDE = mujoco.mjtJoint.mjJNT_SLIDE


@dataclass(frozen=True)
class Run:
    """Neighbouring joints of one type. Their coordinates are contiguous, so a slice and a reshape gather them."""

    kind: mujoco.mjtJoint
    joints: slice
    qpos: slice
    dofs: slice
    width: int  # positions per joint


@dataclass(frozen=True)
class Frames:
    """Turns that compose the orientations of bodies: one for each rotating joint, one for each body without such a joint.

    An index of -1 stands for the world, or for none.
    """

    body: np.ndarray  # the body whose own quaternion a turn includes
    joint: np.ndarray  # the joint of a turn
    mocap: np.ndarray  # the mocap body of a turn
    jumps: tuple[np.ndarray, ...]  # the turns 2ᵏ places before; multiplied in order they give the product from the root
    of_body: np.ndarray  # the last turn of a body
    before_body: np.ndarray  # the turn that a body's position refers to
    before_joint: np.ndarray  # the turn that a joint's position and axis refer to
    is_first: np.ndarray  # whether a joint is the first of its body to rotate, so that the body's quaternion applies
    after_joint: np.ndarray  # the turn of a joint that moves its body about its anchor


def joint_runs(model: mjx.Model | mujoco.MjModel) -> tuple[Run, ...]:
    """Return the joints in order, as runs of one type."""
    runs, start = [], 0
    for end in range(1, model.njnt + 1):
        if end < model.njnt and model.jnt_type[end] == model.jnt_type[start]:
            continue
        kind = mujoco.mjtJoint(int(model.jnt_type[start]))
        width, num_dofs = {_FREE: (7, 6), _BALL: (4, 3)}.get(kind, (1, 1))
        first, dof, count = int(model.jnt_qposadr[start]), int(model.jnt_dofadr[start]), end - start
        qpos, dofs = slice(first, first + width * count), slice(dof, dof + num_dofs * count)
        runs.append(Run(kind, slice(start, end), qpos, dofs, width))
        start = end
    return tuple(runs)


def frames(model: mjx.Model) -> Frames:
    """Return the turns of a model."""
    turns: list[tuple[int, int, int, int]] = []  # body, joint, mocap body, and the turn before
    of_body, before_body = np.full(model.nbody, -1), np.full(model.nbody, -1)
    before_joint, after_joint = np.full(model.njnt, -1), np.full(model.njnt, -1)
    is_first = np.ones(model.njnt, bool)
    for b in range(model.nbody):
        last = int(of_body[model.body_parentid[b]]) if model.body_parentid[b] else -1
        before_body[b] = last
        begun = len(turns)
        for j in joints_of(model, b):
            before_joint[j], is_first[j] = last, len(turns) == begun
            if model.jnt_type[j] == _SLIDE:
                continue
            is_free = model.jnt_type[j] == _FREE
            turns.append((b if is_first[j] and not is_free else -1, j, -1, last))
            last = len(turns) - 1
            after_joint[j] = -1 if is_free else last
        if len(turns) == begun:
            is_mocap = model.body_mocapid[b] >= 0
            turns.append((-1 if is_mocap or b == 0 else b, -1, model.body_mocapid[b], last))
            last = len(turns) - 1
        of_body[b] = last
    body, joint, mocap, before = np.array(turns, int).T
    jumps = []
    while (before >= 0).any():
        jumps.append(before)
        before = np.where(before >= 0, before[before], -1)
    return Frames(body, joint, mocap, tuple(jumps), of_body, before_body, before_joint, is_first, after_joint)


def joints_of(model: mjx.Model, body: int) -> range:
    """Return the joints of a body."""
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def displacements(model: mjx.Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices that sum displacements to the positions of bodies and of joint anchors."""
    # The displacements are, in order: from the parent to each body, from each body to its joints' anchors, and one per joint. The
    # latter is the displacement of a slide, the position of a free joint, or the way back from the anchor to the body.
    num_body, num_joint = model.nbody, model.njnt
    bodies = np.zeros((num_body, num_body + 2 * num_joint))
    anchors = np.zeros((num_joint, num_body + 2 * num_joint))
    for b in range(1, num_body):
        path = bodies[model.body_parentid[b]].copy()
        path[b] = 1
        for j in joints_of(model, b):
            to_anchor, moved = num_body + j, num_body + num_joint + j
            if model.jnt_type[j] == _FREE:
                path[:] = 0
                path[moved] = 1
                anchors[j] = path
                continue
            anchors[j] = path
            anchors[j, to_anchor] = 1
            path[moved] = 1
            path[to_anchor] = model.jnt_type[j] != _SLIDE
        bodies[b] = path
    return bodies, anchors


def moving_dofs(model: mjx.Model) -> np.ndarray:
    """Return 1 where a joint velocity moves a body, else 0 (nbody, nv)."""
    return descendants(model)[model.dof_bodyid].T


def earlier_dofs(model: mjx.Model) -> np.ndarray:
    """Return 1 where a joint velocity (column) moves the axis of another (row), else 0 (nv, nv)."""
    # All joints before an axis move it. The three axes of a ball joint turn with its parent (MuJoCo's convention, not
    # the total derivative). The rotation of a free joint comes after its translation.
    body, dofs = model.dof_bodyid, np.arange(model.nv)
    is_own = (dofs >= model.body_dofadr[body][:, None]) & (dofs < first_dofs(model)[:, None])
    return np.where(is_own, 1.0, moving_dofs(model)[model.body_parentid[body]])


def first_dofs(model: mjx.Model) -> np.ndarray:
    """Return for each joint velocity the first one of its joint, or of the rotation of a free joint."""
    first = model.jnt_dofadr[model.dof_jntid]
    return first + 3 * (np.arange(model.nv) - first >= 3)


def descendants(model: mjx.Model | mujoco.MjModel) -> np.ndarray:
    """Return 1 where a body (column) is a descendant of another (row) or the same, else 0 (nbody, nbody)."""
    below = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):
        below[model.body_parentid[body]] += below[body]
    return below
