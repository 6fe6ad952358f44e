"""How many contacts recorded motions need room for, asked of C MuJoCo."""

import mujoco
import numpy as np

from mjxgrad.rollouts import Trajectory
from mjxgrad.scene import Scene


def contacts_needed(scene: Scene, trajectory: Trajectory, *, clearance: float = 0.01) -> int:
    """Count the contacts that recorded motions came near at once, for `max_contacts` of `load_scene`.

    It is a guess about other motions, and `Trajectory.crowded` tells where it was too few. Call it on the host.

    Args:
        scene: that the rollouts are of; one, not a batch.
        trajectory: from `rollout`, batched or not; of motions like those to come.
        clearance: a pair counts as near within this distance beyond its margin (m).

    Returns:
        The largest number in any state, of those of one friction dimension; at least 1.

    Raises:
        ValueError: if the positions are not finite or do not fit the scene, or the scene is batched or traced.
    """
    full = scene.to_mujoco()
    qpos = np.asarray(trajectory.qpos, dtype=float)
    if qpos.shape[-1] != full.nq:
        raise ValueError(f"trajectory.qpos must have {full.nq} columns in this scene, got {qpos.shape[-1]}")
    if not np.isfinite(qpos).all():
        raise ValueError("trajectory.qpos must be finite, got numbers that are not")
    full.geom_margin[:] += clearance / 2  # margins of a pair are added
    data, most = mujoco.MjData(full), 1
    for position in qpos.reshape(-1, full.nq):
        data.qpos[:] = position
        mujoco.mj_fwdPosition(full, data)
        most = max(most, *np.bincount(data.contact.dim, minlength=1).tolist())
    return most
