"""Central differences of whole steps of C MuJoCo, each from a fresh MjData."""

import mujoco
import numpy as np


def by_whole_steps(model, qpos, qvel, act, ctrl, width=1e-6, **inputs):
    """Return A and B in tangent space."""
    size = 2 * model.nv + model.na

    def step(change):
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.act = qpos, qvel + change[model.nv : 2 * model.nv], act + change[2 * model.nv : size]
        data.ctrl = ctrl + change[size:]
        for name, value in inputs.items():
            getattr(data, name)[:] = value
        mujoco.mj_integratePos(model, data.qpos, change[: model.nv], 1.0)
        mujoco.mj_step(model, data)
        return data

    columns = []
    for change in width * np.eye(size + model.nu):
        above, below = step(change), step(-change)
        mujoco.mj_differentiatePos(model, moved := np.zeros(model.nv), 1.0, below.qpos, above.qpos)
        columns.append(np.concatenate([moved, above.qvel - below.qvel, above.act - below.act]) / (2 * width))
    both = np.transpose(columns)
    return both[:, :size], both[:, size:]
