"""Number of contact slots that recorded motions need, as C MuJoCo counts them."""

import mujoco
import numpy as np

from mjxgrad.rollouts import Trajectory
from mjxgrad.scene import Scene


def contacts_needed(scene: Scene, trajectory: Trajectory, *, clearance: float = 0.01) -> int:
    """Count the simultaneous near contacts of recorded motions, for `max_contacts` of `load_scene`.

    Other motions may need more; `Trajectory.crowded` tells where slots were too few. Call it on the host.

    Args:
        scene: the scene of the rollouts; one, not a batch.
        trajectory: a result of `rollout`, batched or not, whose motions are typical.
        clearance: distance beyond its margin within which a pair counts as near (m).

    Returns:
        The largest number in any state among contacts of one friction dimension; at least 1.

    Raises:
        ValueError: if the positions are not finite or do not fit the scene, or the scene is batched or traced.
    """
    full = scene.to_mujoco()
    qpos = np.asarray(trajectory.qpos, dtype=float)
    if qpos.shape[-1] != full.nq:
        raise ValueError(f"trajectory.qpos must have {full.nq} columns in this scene, got {qpos.shape[-1]}")
    if not np.isfinite(qpos).all():
        raise ValueError("trajectory.qpos must be finite, got numbers that are not")
    full.geom_margin[:] += clearance / 2  # the margins of both geoms add up
    data, most = mujoco.MjData(full), 1
    for position in qpos.reshape(-1, full.nq):
        data.qpos[:] = position
        mujoco.mj_fwdPosition(full, data)
        most = max(most, *np.bincount(data.contact.dim, minlength=1).tolist())
    return most
