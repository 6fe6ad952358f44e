"""Rollouts of controls by C MuJoCo, on all cores, behind the same call as our own: nothing to compile, and no derivative."""

import math
import os
import threading

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float

from mjxgrad.scene import Scene
from mjxgrad.scene.scene import numbers_of, with_numbers

_Sequences = tuple[Float[Array, "horizon nq"], Float[Array, "horizon nv"], Float[Array, "horizon na"]]
_NUM_THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def roll_out(
    scene: Scene,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    act: Float[Array, " na"],
    time: Float[Array, ""],
    controls: Float[Array, "horizon nu"],
) -> _Sequences:
    """Return positions, velocities and activations after each step, as MuJoCo gives them.

    The model's numbers are arguments of the call, so that it may be traced and mapped over, the softness of contacts included.
    """
    shapes = [jax.ShapeDtypeStruct((len(controls), *part.shape), part.dtype) for part in (qpos, qvel, act)]
    run = _Threads(scene.mj_model)

    @jax.custom_jvp
    def call(*arguments):
        return tuple(jax.pure_callback(run, shapes, *arguments, vmap_method="expand_dims"))

    @call.defjvp
    def _refuse(primals, tangents):
        raise ValueError('engine="mujoco" has no derivative: take "mjx", or an estimator of zeroth order')

    return call(numbers_of(scene.model), time[None], qpos, qvel, act, controls)


class _Threads:
    """A pool of threads that rolls out batches; arrays have the batch's axes in front, of length one where they are shared."""

    def __init__(self, mj_model: mujoco.MjModel):
        self.mj_model, self.lock = mj_model, threading.Lock()
        self.pool = mujoco.rollout.Rollout(nthread=_NUM_THREADS)
        self.data = [mujoco.MjData(mj_model) for _ in range(_NUM_THREADS)]

    def __call__(self, numbers: dict[str, Array], *arguments: Array) -> tuple[np.ndarray, ...]:
        *start, controls = (np.asarray(x) for x in arguments)
        batch_ndim = start[0].ndim - 1
        values = {name: np.asarray(value) for name, value in numbers.items()}
        leading = [x.shape[:batch_ndim] for x in (*start, controls, *values.values())]
        batch = np.broadcast_shapes(*leading)

        def flat(x: np.ndarray) -> np.ndarray:
            return np.broadcast_to(x, batch + x.shape[batch_ndim:]).reshape(math.prod(batch), *x.shape[batch_ndim:])

        initial = np.concatenate([flat(x) for x in start], axis=1)
        size = mujoco.mj_stateSize(self.mj_model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        initial = np.pad(initial.astype(float), ((0, 0), (0, size - initial.shape[1])))
        varied = {name: flat(x) for name, x in values.items() if math.prod(x.shape[:batch_ndim]) > 1}
        shared = {name: x.reshape(x.shape[batch_ndim:]) for name, x in values.items() if name not in varied}
        base = with_numbers(self.mj_model, shared)
        # A state that is not finite stays so, and is seen.
        base.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        models = [base] * len(initial)
        if varied:
            models = [with_numbers(base, {name: x[i] for name, x in varied.items()}) for i in range(len(initial))]
        with self.lock:
            # Numbers that are not finite are seen in the result; MuJoCo would write them into a file.
            mujoco.set_mju_user_warning(lambda _: None)
            try:
                found = self.pool.rollout(models, self.data, initial, flat(controls).astype(float))[0]
            finally:
                mujoco.set_mju_user_warning(None)
        ends = np.cumsum([x.shape[-1] for x in start])
        pieces = zip(np.split(np.asarray(found), ends, axis=2)[1 : len(start)], start[1:], strict=True)
        return tuple(piece.reshape(*batch, *piece.shape[1:]).astype(x.dtype) for piece, x in pieces)
