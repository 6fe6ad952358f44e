"""Where MuJoCo keeps what: its state as a vector, the inputs of a step, and changes of a state in tangent space.

A state that goes on has positions, velocities and the *rest*: activations, and histories of delayed actuators and sensors and
states of plugins. A change of it has as many numbers as there are velocities in place of positions.
"""

from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Float

INPUTS = ("ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat")
"""What may be given to each step, in the order in which MuJoCo keeps it."""
MOTION = ("qpos", "qvel", "act", "history", "plugin")
"""What goes on from step to step, beside time."""
_STATE = mujoco.mjtState
USER = _STATE.mjSTATE_USER.value & ~_STATE.mjSTATE_USERDATA.value
EVERY = _STATE.mjSTATE_INTEGRATION.value
_QUATERNIONS = {mujoco.mjtJoint.mjJNT_FREE.value: 3, mujoco.mjtJoint.mjJNT_BALL.value: 0}
_SMALL = 1e-4  # rad, below which series replace quotients


class Layout:
    """The places of a model's states and changes: slices of MuJoCo's vector of everything that a step depends on, by part."""

    def __init__(self, model: mujoco.MjModel):
        names = ("time", *MOTION, "warmstart", *INPUTS)
        bits = {name: getattr(_STATE, f"mjSTATE_{name.upper()}").value for name in names}
        begins = {name: mujoco.mj_stateSize(model, EVERY & (bit - 1)) for name, bit in bits.items()}
        ends = {name: begins[name] + mujoco.mj_stateSize(model, bit) for name, bit in bits.items()}
        self.places = {name: slice(begins[name], ends[name]) for name in names}
        self.size = mujoco.mj_stateSize(model, EVERY)
        self.sizes = {name: ends[name] - begins[name] for name in MOTION}
        self.nv, self.num_rest = model.nv, sum(self.sizes[name] for name in MOTION[2:])
        self.num_changes = 2 * model.nv + self.num_rest
        whole = np.arange(self.size)
        self.rest = np.concatenate([whole[self.places[name]] for name in MOTION[2:]])
        self.motion = np.concatenate([whole[self.places[name]] for name in MOTION])
        kinds = list(zip(model.jnt_type.tolist(), model.jnt_qposadr.tolist(), model.jnt_dofadr.tolist(), strict=True))
        turning = [
            (qpos + _QUATERNIONS[kind], dof + _QUATERNIONS[kind]) for kind, qpos, dof in kinds if kind in _QUATERNIONS
        ]
        self.quaternions = np.array([qpos for qpos, _ in turning], int)[:, None] + np.arange(4)
        self.turns = np.array([dof for _, dof in turning], int)[:, None] + np.arange(3)
        is_plain = np.ones(model.nv, bool)
        is_plain[self.turns.ravel()] = False
        self.plain_dofs = np.flatnonzero(is_plain)
        self.plain_qpos = np.setdiff1d(np.arange(model.nq), self.quaternions.ravel())

    def moved(self, rows: Float[np.ndarray, "... size"], change: Float[np.ndarray, "... some"]) -> np.ndarray:
        """Return states moved in tangent space: by their positions, or by all of a change."""
        rows = np.array(np.broadcast_to(rows, (*change.shape[:-1], rows.shape[-1])))
        first = self.places["qpos"].start
        rows[..., first + self.plain_qpos] += change[..., self.plain_dofs]
        if self.turns.size:
            at = first + self.quaternions
            rows[..., at] = _times(rows[..., at], _exponential(change[..., self.turns]))
        if change.shape[-1] > self.nv:
            rows[..., self.places["qvel"]] += change[..., self.nv : 2 * self.nv]
            rows[..., self.rest] += change[..., 2 * self.nv :]
        return rows

    def difference(self, ends: Float[np.ndarray, "... size"], starts: Float[np.ndarray, "... size"]) -> np.ndarray:
        """Return the changes that move starts to ends."""
        change = np.empty((*np.broadcast_shapes(ends.shape[:-1], starts.shape[:-1]), self.num_changes))
        at = self.places["qpos"]
        change[..., : self.nv] = self.displacement(ends[..., at], starts[..., at])
        change[..., self.nv : 2 * self.nv] = ends[..., self.places["qvel"]] - starts[..., self.places["qvel"]]
        change[..., 2 * self.nv :] = ends[..., self.rest] - starts[..., self.rest]
        return change

    def displacement(self, ends: Float[np.ndarray, "... nq"], starts: Float[np.ndarray, "... nq"]) -> np.ndarray:
        """Return the changes that move positions to others; a quaternion needs no length of 1."""
        change = np.empty((*np.broadcast_shapes(ends.shape[:-1], starts.shape[:-1]), self.nv))
        change[..., self.plain_dofs] = ends[..., self.plain_qpos] - starts[..., self.plain_qpos]
        if self.turns.size:
            inverse = starts[..., self.quaternions] * np.array([1.0, -1.0, -1.0, -1.0])
            change[..., self.turns] = _logarithm(_times(inverse, ends[..., self.quaternions]))
        return change

    def carry(self, turned: Float[np.ndarray, "... nv"], values: Float[np.ndarray, "... nv columns"]) -> np.ndarray:
        """Return how changes of a position look after a turn: those of quaternions are seen from the turned body."""
        return self._by_turns(turned, values, lambda turn: np.swapaxes(_matrix(turn), -1, -2))

    def follow(self, turned: Float[np.ndarray, "... nv"], values: Float[np.ndarray, "... nv columns"]) -> np.ndarray:
        """Return how changes of a turn change the position after it: the right Jacobian of the exponential map."""
        return self._by_turns(turned, values, _right_jacobian)

    def _by_turns(self, turned: np.ndarray, values: np.ndarray, matrix: Callable) -> np.ndarray:
        if not self.turns.size:
            return values
        values = values.copy()
        values[..., self.turns, :] = matrix(turned[..., self.turns]) @ values[..., self.turns, :]
        return values


def _times(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    a, b, c, d = np.moveaxis(left, -1, 0)
    w, x, y, z = np.moveaxis(right, -1, 0)
    parts = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return np.stack(parts, axis=-1)


def _exponential(turn: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * turn], axis=-1)


def _logarithm(quaternion: np.ndarray) -> np.ndarray:
    scalar, vector = quaternion[..., :1], quaternion[..., 1:]
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(size, np.abs(scalar))
    factor = np.where(size > 1e-12, angle / np.where(size > 1e-12, size, 1.0), 2.0)
    return np.where(scalar < 0, -factor, factor) * vector


def _skew(turn: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(turn, -1, 0)
    none = np.zeros_like(x)
    return np.stack([np.stack(row, -1) for row in ((none, -z, y), (z, none, -x), (-y, x, none))], -2)


def _coefficients(turn: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return sin θ/θ, (1 - cos θ)/θ² and (θ - sin θ)/θ³ of turns."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    safe = np.where(angle > _SMALL, angle, 1.0)
    exact = np.sin(safe) / safe, (1 - np.cos(safe)) / safe**2, (safe - np.sin(safe)) / safe**3
    series = 1 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    return tuple(np.where(angle > _SMALL, one, other) for one, other in zip(exact, series, strict=True))


def _matrix(turn: np.ndarray) -> np.ndarray:
    (sine, cosine, _), skew = _coefficients(turn), _skew(turn)
    return np.eye(3) + sine * skew + cosine * skew @ skew


def _right_jacobian(turn: np.ndarray) -> np.ndarray:
    (_, cosine, rest), skew = _coefficients(turn), _skew(turn)
    return np.eye(3) - cosine * skew + rest * skew @ skew
