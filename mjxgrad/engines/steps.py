"""Single steps of many states, by one call of C MuJoCo, in which Python's lock is free."""

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from mjxgrad._interrupts import give_up_if_stopped
from mjxgrad.engines.layout import EVERY, MOTION, USER, Layout

START = ("time", *MOTION)
_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_FEW = 4  # states, which are stepped one by one: a call takes as long as several steps


class Stepper:
    """Memory and threads for steps of one model, or of models like it."""

    def __init__(self, model: mujoco.MjModel, layout: Layout, num_threads: int):
        self.layout, self.size = layout, mujoco.mj_stateSize(model, _PHYSICS)
        self.rollout = mujoco.rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        self.memory = [mujoco.MjData(model) for _ in range(num_threads)]

    def full(self, rows: Float[np.ndarray, "rows size"]) -> Float[np.ndarray, "rows physics"]:
        return np.concatenate([rows[:, self.layout.places[name]] for name in START], axis=1)

    def motions(self, found: Float[np.ndarray, "... physics"]) -> dict[str, np.ndarray]:
        """Return the parts of physical states, of which plugins come last."""
        parts = {name: found[..., self.layout.places[name]] for name in MOTION[:-1]}
        return parts | {"plugin": found[..., found.shape[-1] - self.layout.sizes["plugin"] :]}

    def __call__(
        self, rows: Float[np.ndarray, "rows size"], models: list[mujoco.MjModel]
    ) -> Float[np.ndarray, "rows size"]:
        """Return whole states after a step of each: the motion, where the rest is as it was."""
        give_up_if_stopped()
        ends, places = rows.copy(), self.layout.places
        if len(rows) <= _FEW:
            for model, end in zip(models, ends, strict=True):
                mujoco.mj_setState(model, self.memory[0], end, EVERY)
                mujoco.mj_step(model, self.memory[0])
                mujoco.mj_getState(model, self.memory[0], end, EVERY)
            return ends
        user = np.ascontiguousarray(rows[:, None, places["ctrl"].start : places["mocap_quat"].stop])
        warm, found = np.ascontiguousarray(rows[:, places["warmstart"]]), np.empty((len(rows), 1, self.size))
        self.rollout.rollout(
            models, self.memory, self.full(rows), user, control_spec=USER, skip_checks=True, nstep=1,
            initial_warmstart=warm, state=found, sensordata=np.empty((len(rows), 1, models[0].nsensordata)),
        )  # fmt: skip
        for name, value in self.motions(found[:, 0]).items():
            ends[:, places[name]] = value
        return ends
