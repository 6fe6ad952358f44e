r"""A proof that two geoms stay apart, whatever the joints between them do.

Only joints between two bodies move them against each other. Carry the points of the first geom along the kinematic path
into the frame of the second one: hinges turn them, slides shift them, bodies place them. Three facts bound the distance.

1. *Bounding volumes.* Each geom lies within a capsule: a segment with a radius, a plane within its half-space. Their
   distance is never greater than that of the geoms.
2. *One joint moves the distance by little.* If one joint j changes by $\theta$, one side of the path turns as a rigid body
   against the other. A point at distance $\rho$ of a hinge's anchor moves by at most $\rho |\theta|$, and
   $|a - b| \ge |a' - b| - |a - a'|$, so the distance of the two sets falls by at most $\rho_j |\theta|$, with $\rho_j$ the
   farthest that a point of the set can be from that anchor. Which side turns is a matter of the frame, so the smaller reach
   of the two counts. For a slide $\rho_j = 1$. Joint after joint, over a box of joint positions with centre c and half
   widths r: $\min d \ge d(c) - \sum_j \rho_j r_j$.
3. *Reach.* The points of a set that lies in a ball $(c, s)$ lie within $|c - p| + s$ of an anchor p, and after any turn about it
   in the ball $(p, |c - p| + s)$. Passed on along the path, this gives $\rho_j$ for all positions of the other joints at once.

Branch and bound over the box of all joint positions with this inequality either proves that the distance is at least
what is asked everywhere, or finds a position where the bounding volumes are closer, or gives up; only a proof counts.

What is assumed: a hinge may take every angle and a slide every position, unless the caller trusts limits. A ball joint takes
every orientation. Free joints, mocap bodies and slides without trusted limits between two geoms admit no proof. Lengths are
those of the model given.
"""

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from mjxgrad.scene.volume import Carried, Volume, distance_from, rotation_matrix, volume_of

_JOINT = mujoco.mjtJoint
_MAX_BOXES = 20_000  # tried for one pair before giving up; a proof through three hinges takes some hundreds
_BATCH = 2048


@dataclass(frozen=True)
class _Move:
    """One motion of points along the path: of a joint, or the fixed placement of a body."""

    kind: Literal["fixed", "hinge", "slide", "ball"]
    vector: Float[np.ndarray, " 3"]
    """Translation, axis of hinge or slide; of no use for a ball."""
    anchor: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    """Of a fixed placement."""
    interval: tuple[float, float] = (0.0, 0.0)

    def inverse(self) -> "_Move":
        if self.kind == "fixed":
            rotation = self.rotation.T
            return _Move("fixed", -rotation @ self.vector, self.anchor, rotation)
        return _Move(self.kind, -self.vector, self.anchor, self.rotation, self.interval)


def proven_distance(
    model: mujoco.MjModel, geom1: int, geom2: int, *, at_least: float, beyond_limits: float | None = None
) -> float | None:
    """Give a distance (m) that two geoms keep at all joint positions, if one of some size can be proven.

    Args:
        model: of C MuJoCo.
        geom1: index of a geom.
        geom2: index of another.
        at_least: what is to be proven (m).
        beyond_limits: how far joints may leave the ranges of their limits (rad or m); None trusts no limit, so that
            hinges may turn all round and slides slide without end.

    Returns:
        The distance proven, not below `at_least`; None without a proof.
    """
    moves = _path(model, geom1, geom2, beyond_limits)
    if moves is None:
        return None
    first, second = volume_of(model, geom1), volume_of(model, geom2)
    proven = _proven(first, moves, second, at_least)
    if proven is None and any(move.kind == "ball" for move in moves):
        # A ball joint makes a ball of what is carried through it, which may be much more than the other geom becomes.
        proven = _proven(second, _reversed(moves), first, at_least)
    return proven


def _proven(first: Volume, moves: list[_Move], second: Volume, at_least: float) -> float | None:
    if first.is_plane and (second.is_plane or any(move.kind == "ball" for move in moves)):
        return None
    reach = np.minimum(_reaches(first, moves), _reaches(second, _reversed(moves))[::-1])

    def distance(positions: Float[np.ndarray, "boxes joints"]) -> Float[np.ndarray, " boxes"]:
        return distance_from(_carried(first, moves, positions), second)

    intervals = [move.interval for move in moves if move.kind in ("hinge", "slide")]
    low, high = np.array(intervals).reshape(-1, 2).T
    return _branch_and_bound(distance, (low + high) / 2, (high - low) / 2, reach, at_least)


def _reversed(moves: list[_Move]) -> list[_Move]:
    return [move.inverse() for move in reversed(moves)]


def _branch_and_bound(distance, centre, half, reach, at_least: float) -> float | None:
    """Lower bound of a distance over a box of joint positions; None where it is not proven to be `at_least`."""
    boxes, halves = centre[None], half[None]
    proven, tried = np.inf, 0
    while len(boxes):
        batch, width = boxes[:_BATCH], halves[:_BATCH]
        tried += len(batch)
        if tried > _MAX_BOXES:
            return None
        found = distance(batch)
        if (found < at_least).any():
            return None
        bound = found - width @ reach
        is_done = bound >= at_least
        proven = min(proven, bound[is_done].min(initial=np.inf))
        # The halves first: depth before breadth keeps few boxes in memory and meets a touching position sooner.
        split, narrower = _split(batch[~is_done], width[~is_done], reach)
        boxes, halves = np.concatenate([split, boxes[_BATCH:]]), np.concatenate([narrower, halves[_BATCH:]])
    return float(proven)


def _split(boxes, halves, reach) -> tuple[np.ndarray, np.ndarray]:
    """Halve every box across the joint that moves the geoms farthest."""
    if not len(boxes):
        return boxes, halves
    widest = np.argmax(halves * reach, axis=1)
    halves = halves.copy()
    rows = np.arange(len(boxes))
    halves[rows, widest] /= 2
    shift = np.zeros_like(boxes)
    shift[rows, widest] = halves[rows, widest]
    return np.concatenate([boxes - shift, boxes + shift]), np.concatenate([halves, halves])


def _path(model: mujoco.MjModel, geom1: int, geom2: int, beyond_limits: float | None) -> list[_Move] | None:
    """Motions from the frame of the first geom's body to that of the second's; None if one of them has no bound."""
    bodies = [int(model.geom_bodyid[geom]) for geom in (geom1, geom2)]
    up, down = ([*_ancestors(model, body)] for body in bodies)
    common = next(body for body in up if body in down)
    moves: list[_Move] = []
    for side in (up, down):
        legs = []
        for body in side[: side.index(common)]:
            found = _body_moves(model, body, beyond_limits)
            if found is None:
                return None
            legs += found
        moves += legs if side is up else _reversed(legs)
    return moves


def _ancestors(model: mujoco.MjModel, body: int):
    yield body
    while body:
        body = int(model.body_parentid[body])
        yield body


def _body_moves(model: mujoco.MjModel, body: int, beyond_limits: float | None) -> list[_Move] | None:
    """Motions from a body's frame to its parent's: the last joint acts first."""
    if model.body_mocapid[body] >= 0:
        return None
    moves: list[_Move] = []
    start = int(model.body_jntadr[body])
    for joint in reversed(range(start, start + int(model.body_jntnum[body]))):
        move = _joint_move(model, joint, beyond_limits)
        if move is None:
            return None
        moves.append(move)
    return [*moves, _Move("fixed", model.body_pos[body].copy(), np.zeros(3), rotation_matrix(model.body_quat[body]))]


def _joint_move(model: mujoco.MjModel, joint: int, beyond_limits: float | None) -> _Move | None:
    kind = _JOINT(int(model.jnt_type[joint]))
    axis, anchor = model.jnt_axis[joint].copy(), model.jnt_pos[joint].copy()
    if kind == _JOINT.mjJNT_FREE:
        return None
    if kind == _JOINT.mjJNT_BALL:
        return _Move("ball", axis, anchor, np.eye(3))
    is_hinge = kind == _JOINT.mjJNT_HINGE
    interval = (-np.pi, np.pi) if is_hinge else None
    if beyond_limits is not None and model.jnt_limited[joint] and not _ignores_limits(model):
        low, high = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]]
        low, high = float(low - beyond_limits), float(high + beyond_limits)
        interval = (low, high) if not is_hinge or high - low < 2 * np.pi else interval
    if interval is None:
        return None
    return _Move("hinge" if is_hinge else "slide", axis, anchor, np.eye(3), interval)


def _ignores_limits(model: mujoco.MjModel) -> bool:
    bits = mujoco.mjtDisableBit
    return bool(model.opt.disableflags & (bits.mjDSBL_LIMIT.value | bits.mjDSBL_CONSTRAINT.value))


def _reaches(volume: Volume, moves: list[_Move]) -> Float[np.ndarray, " joints"]:
    """By how much a unit of each joint moves a point of the volume at most, in the order of the path."""
    (centre, radius), reaches = volume.ball, []
    for move in moves:
        if move.kind == "fixed":
            centre = move.rotation @ centre + move.vector
        elif move.kind == "slide":
            low, high = move.interval
            reaches.append(1.0)
            centre, radius = centre + move.vector * (low + high) / 2, radius + (high - low) / 2
        else:
            radius = float(np.linalg.norm(centre - move.anchor)) + radius
            centre = move.anchor
            if move.kind == "hinge":
                reaches.append(radius)
    return np.array(reaches)


def _carried(volume: Volume, moves: list[_Move], positions: Float[np.ndarray, "boxes joints"]) -> Carried:
    """The volume in the frame at the end of the path, at the positions in the middle of each box."""
    ends = np.broadcast_to(volume.ends, (len(positions), 2, 3))
    radius = np.full(len(positions), volume.radius)
    columns = iter(positions.T)
    for move in moves:
        if move.kind == "fixed":
            ends = ends @ move.rotation.T + move.vector
        elif move.kind == "slide":
            ends = ends + next(columns)[:, None, None] * move.vector
        elif move.kind == "hinge":
            angle = next(columns)[:, None, None]
            arm = ends - move.anchor
            along = (arm @ move.vector)[..., None] * move.vector
            across = np.cross(move.vector, arm)
            ends = move.anchor + along + np.cos(angle) * (arm - along) + np.sin(angle) * across
        else:
            radius = radius + np.linalg.norm(ends - move.anchor, axis=-1).max(axis=1)
            ends = np.broadcast_to(move.anchor, ends.shape)
    return Carried(ends, radius, volume.is_plane)
