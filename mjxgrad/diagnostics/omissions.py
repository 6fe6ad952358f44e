"""Whether recorded motions needed what their scene leaves out, asked of the full model in C MuJoCo.

What is left out on a user's word has no proof, and a rollout cannot notice by itself: what is left out is never looked at.
So every recorded state is put into the full C model, where an omitted contact or limit shows, and stepped with and
without the omissions.
"""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import ArrayLike, Float

from mjxgrad._rollout import Trajectory
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.scene import LeaveOut, Scene
from mjxgrad.scene.refusals import element_name

# Of the C solver, so that two models are compared and not two ways to an optimum.
_TOLERANCE, _ITERATIONS = 1e-12, 200


@dataclass(frozen=True)
class Missed:
    """An omitted contact or limit, by the names of geoms or joint, that a recorded motion reached.

    First at a time after the start of its rollout (s), in some of all states, at most so deep beyond the margin (m or rad).
    """

    what: str
    time: float
    num_states: int
    depth: float


@dataclass(frozen=True)
class OmissionCheck:
    """What the full model says of recorded motions.

    Attributes:
        missed: omitted contacts and limits that acted, in order of time; none if nothing was missed.
        num_states: states looked at.
        force_error: largest difference of the generalised constraint force in one state with and without the omissions, both in C
            MuJoCo (N or N m).
        force_scale: largest generalised constraint force in the full model (N or N m).
        step_error: largest difference of positions and velocities after one step from one state, with and without the
            omissions, both in C MuJoCo (m, rad and per s).
        recorded_error: likewise between what was recorded and the full model; besides omissions all that MJX and the
            precision make different.
    """

    missed: tuple[Missed, ...]
    num_states: int
    force_error: float
    force_scale: float
    step_error: float
    recorded_error: float

    @property
    def is_sound(self) -> bool:
        """Whether the recorded motions needed nothing of what was left out."""
        return not self.missed

    def summary(self) -> str:
        """Say in one line per finding what was missed, or that nothing was."""
        difference = (
            f"with and without the omissions constraint forces differ by {self.force_error:.2g} of {self.force_scale:.3g}, "
            f"a step by {self.step_error:.2g}"
        )
        if self.is_sound:
            return f"nothing that was left out acted in {self.num_states} states; {difference}"
        lines = [
            f"{one.what} acted in {one.num_states} of {self.num_states} states, first at {one.time:.4g} s, "
            f"by up to {one.depth:.3g}"
            for one in self.missed
        ]
        return "\n".join([*lines, difference])


def check_omissions(scene: Scene, trajectory: Trajectory, act: Float[ArrayLike, "..."] | None = None) -> OmissionCheck:
    """Replay recorded rollouts in the full C model and compare. Call it on the host.

    Contacts are found by C MuJoCo in every recorded state. What acts only between two of them, within the stages of a
    Runge-Kutta step, shows in `step_error` alone.

    Args:
        scene: that the rollouts are of; one, not a batch.
        trajectory: from `rollout`, batched or not.
        act: activations that the rollouts started from; those of the scene's data, if left out.

    Returns:
        What was missed, and how much difference it makes.

    Raises:
        ValueError: if the trajectory has numbers that are not finite or does not fit the scene, or the scene is batched
            or traced.
    """
    full = scene.to_mujoco()
    full.opt.tolerance, full.opt.iterations = min(full.opt.tolerance, _TOLERANCE), max(full.opt.iterations, _ITERATIONS)
    lean = without_omissions(scene, full)
    qpos, qvel, ctrl = _rollouts(full, trajectory)
    start = np.asarray(scene.data.act if act is None else act, dtype=float)
    start = np.broadcast_to(start, (len(qpos), full.na))
    pairs = {frozenset((pair.geom1, pair.geom2)): str(pair) for pair in scene.omitted_pairs}
    joints = np.flatnonzero(full.jnt_limited.astype(bool) & ~lean.jnt_limited.astype(bool))
    found: dict[str, list[tuple[int, float]]] = {}
    force, scale, step, recorded = 0.0, 0.0, 0.0, 0.0
    whole, less = mujoco.MjData(full), mujoco.MjData(lean)
    # From its first bad step on a rollout stays where it is, which no model does.
    first_bad = np.atleast_1d(np.asarray(trajectory.first_bad_step)).ravel()
    last = np.where(first_bad >= 0, first_bad, qpos.shape[1] - 1)
    for i in range(len(qpos)):
        whole.act[:] = start[i]
        for t in range(last[i] + 1):
            whole.qpos[:], whole.qvel[:] = qpos[i, t], qvel[i, t]
            whole.ctrl[:] = ctrl[i, min(t, ctrl.shape[1] - 1)]
            whole.qacc_warmstart[:] = 0.0
            for name in ("qpos", "qvel", "ctrl", "act", "qacc_warmstart"):
                getattr(less, name)[:] = getattr(whole, name)
            mujoco.mj_forward(full, whole)
            mujoco.mj_forward(lean, less)
            for what, depth in _acting(full, whole, pairs, joints).items():
                found.setdefault(what, []).append((t, depth))
            force = max(force, _largest(whole.qfrc_constraint - less.qfrc_constraint))
            scale = max(scale, _largest(whole.qfrc_constraint))
            if t == last[i]:
                break
            mujoco.mj_step(full, whole)
            mujoco.mj_step(lean, less)
            step = max(step, _largest(whole.qpos - less.qpos), _largest(whole.qvel - less.qvel))
            recorded = max(recorded, _largest(whole.qpos - qpos[i, t + 1]), _largest(whole.qvel - qvel[i, t + 1]))
    missed = [
        Missed(what, min(t for t, _ in seen) * full.opt.timestep, len(seen), max(depth for _, depth in seen))
        for what, seen in found.items()
    ]
    missed = tuple(sorted(missed, key=lambda one: one.time))
    return OmissionCheck(missed, int((last + 1).sum()), force, scale, step, recorded)


def unused(scene: Scene, trajectory: Trajectory, *, clearance: float = 0.01, limit_clearance: float = 0.05) -> LeaveOut:
    """Name the contacts and limits that recorded motions did not come near, for `load_scene` to leave out.

    Such a list is a guess about other motions: check them by `check_omissions`.

    Args:
        scene: that the rollouts are of, best without omissions.
        trajectory: from `rollout`, batched or not; of motions like those to come.
        clearance: a pair counts as near within this distance beyond its margin (m).
        limit_clearance: a limit counts as near within this distance beyond its margin (m or rad).

    Returns:
        What to pass as `leave_out`.

    Raises:
        ValueError: as `check_omissions`.
    """
    full = scene.to_mujoco()
    qpos, qvel, _ = _rollouts(full, trajectory)
    full.geom_margin[:] += clearance / 2  # margins of a pair are added
    data, near, reached = mujoco.MjData(full), set(), np.zeros(full.njnt, bool)
    for position, velocity in zip(qpos.reshape(-1, full.nq), qvel.reshape(-1, full.nv), strict=True):
        data.qpos[:], data.qvel[:] = position, velocity
        mujoco.mj_fwdPosition(full, data)
        near |= {frozenset(pair) for pair in data.contact.geom.tolist()}
        reached |= _beyond_limit(full, data.qpos) > -limit_clearance
    pairs = tuple(
        pair.names
        for pair in contact_pairs(scene.mj_model)
        if pair.explicit < 0 and frozenset((pair.geom1, pair.geom2)) not in near
    )
    joints = [full.joint(j).name for j in np.flatnonzero(full.jnt_limited.astype(bool) & ~reached)]
    return LeaveOut(pairs=pairs, limits=tuple(filter(None, joints)))


def contacts_needed(scene: Scene, trajectory: Trajectory, *, clearance: float = 0.01) -> int:
    """Count the contacts that recorded motions came near at once, for `max_contacts` of `load_scene`.

    It is a guess about other motions, and `Trajectory.crowded` tells where it was too few. Arguments are those of `unused`.

    Returns:
        The largest number in any state, of those of one friction dimension; at least 1.

    Raises:
        ValueError: as `check_omissions`.
    """
    full = scene.to_mujoco()
    qpos, _, _ = _rollouts(full, trajectory)
    full.geom_margin[:] += clearance / 2  # margins of a pair are added
    data, most = mujoco.MjData(full), 1
    for position in qpos.reshape(-1, full.nq):
        data.qpos[:] = position
        mujoco.mj_fwdPosition(full, data)
        most = max(most, *np.bincount(data.contact.dim, minlength=1).tolist())
    return most


def without_omissions(scene: Scene, full: mujoco.MjModel) -> mujoco.MjModel:
    """Give the full C model without what the scene leaves out of its constraints."""
    lean = copy.deepcopy(full)
    for name in ("geom_contype", "geom_conaffinity", "jnt_limited"):
        getattr(lean, name)[:] = np.asarray(getattr(scene.model, name))
    return lean


def _acting(
    full: mujoco.MjModel, data: mujoco.MjData, pairs: dict[frozenset[int], str], joints: np.ndarray
) -> dict[str, float]:
    """Say how deep each of the omitted pairs and limits is that acts in a state."""
    deepest: dict[str, float] = {}
    depths = data.contact.includemargin - data.contact.dist
    for geoms, depth in zip(data.contact.geom.tolist(), depths.tolist(), strict=True):
        what = pairs.get(frozenset(geoms))
        if what is not None and depth > 0:
            deepest[f"contact of {what}"] = max(deepest.get(f"contact of {what}", 0.0), depth)
    beyond = _beyond_limit(full, data.qpos)
    for joint in joints[beyond[joints] > 0]:
        name = element_name(full, mujoco.mjtObj.mjOBJ_JOINT, int(joint))
        deepest[f"limit of {name}"] = float(beyond[joint])
    return deepest


def _beyond_limit(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """How far each joint is beyond the margin of its nearer limit; negative within, minus infinity without one."""
    beyond = np.full(model.njnt, -np.inf)
    for joint in np.flatnonzero(model.jnt_limited):
        address, (low, high) = int(model.jnt_qposadr[joint]), model.jnt_range[joint]
        if mujoco.mjtJoint(int(model.jnt_type[joint])) == mujoco.mjtJoint.mjJNT_BALL:
            turn = np.zeros(3)
            mujoco.mju_quat2Vel(turn, qpos[address : address + 4] / np.linalg.norm(qpos[address : address + 4]), 1.0)
            distance = max(low, high) - np.linalg.norm(turn)
        else:
            distance = min(qpos[address] - low, high - qpos[address])
        beyond[joint] = model.jnt_margin[joint] - distance
    return beyond


def _rollouts(model: mujoco.MjModel, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities and controls with one leading axis of rollouts."""
    parts = []
    for name, size in (("qpos", model.nq), ("qvel", model.nv), ("ctrl", model.nu)):
        value = np.asarray(getattr(trajectory, name), dtype=float)
        if value.shape[-1] != size:
            raise ValueError(f"trajectory.{name} must have {size} columns in this scene, got {value.shape[-1]}")
        if not np.isfinite(value).all():
            raise ValueError(f"trajectory.{name} must be finite, got numbers that are not")
        rollouts = int(np.prod(value.shape[:-2]))
        parts.append(value.reshape(rollouts, *value.shape[-2:]))
    return tuple(parts)


def _largest(difference: np.ndarray) -> float:
    return float(np.abs(difference).max(initial=0.0))
