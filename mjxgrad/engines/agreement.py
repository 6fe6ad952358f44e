"""Where MJX moves a scene otherwise than C MuJoCo: a few steps of a scene's first rollout, taken again by C MuJoCo.

To compile a step for the sake of a comparison takes up to a minute, and to run it operation by operation as long (a hopper's: 14
and 67 s). The first rollout has such steps already.
"""

import functools

import mujoco
import numpy as np
from jaxtyping import Array

from mjxgrad.engines.layout import INPUTS
from mjxgrad.engines.pool import pool_of
from mjxgrad.engines.state import Trajectory
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import changed_numbers

_NUM_STEPS = 8
_APART = 0.05  # of the largest change of a speed in a step; solvers of few iterations are off by some thousandths
_SMALLEST = 1e-3  # of such a change (m/s or rad/s)


@functools.lru_cache(maxsize=64)
def _once(mj_model: mujoco.MjModel) -> list[bool]:
    return []


def parting(scene: Scene, found: Trajectory, inputs: dict[str, Array]) -> str | None:
    """Say where steps of a known rollout by MJX are not C MuJoCo's; None where they are, or were looked at before."""
    known = _once(scene.mj_model)
    last = len(found.ctrl) if found.first_bad_step < 0 else int(found.first_bad_step)
    if known or not last:
        return None
    known.append(True)
    steps = np.unique(np.linspace(0, last - 1, _NUM_STEPS).astype(int))
    starts = {name: np.asarray(getattr(found, name))[steps] for name in ("qpos", "qvel", "act")}
    given = {name: np.asarray(getattr(scene.data, name)) for name in INPUTS[1:]}
    given = {name: np.broadcast_to(value, (len(steps), *value.shape)) for name, value in given.items()}
    given |= {name: np.asarray(value)[steps] for name, value in inputs.items()}
    given = {name: value[:, None] for name, value in given.items() if value.size}
    given["ctrl"] = np.asarray(found.ctrl)[steps][:, None]
    numbers = {name: np.asarray(value)[None] for name, value in changed_numbers(scene).items()}
    after = pool_of(scene.mj_model).run(numbers, {"time": np.zeros((len(steps), 1)), **starts}, given)["qvel"][:, 0]
    ours = np.asarray(found.qvel)[steps + 1]
    off = np.abs(ours - after) / np.maximum(np.abs(after - starts["qvel"]).max(axis=1, keepdims=True), _SMALLEST)
    place, dof = np.unravel_index(off.argmax(), off.shape)
    if not off[place, dof] > _APART:
        return None
    joint = scene.mj_model.dof_jntid[dof]
    name = scene.mj_model.joint(joint).name or f"joint {joint}"
    single = " or take double precision, if rounding decides what touches" if ours.dtype == np.float32 else ""
    return (
        f"step {steps[place]} by MJX is not C MuJoCo's: {name} has a speed of {ours[place, dof]:.4g} after it, by C MuJoCo "
        f"{after[place, dof]:.4g}; load it with engine='mujoco'{single}"
    )
