"""Motions of a scene, recorded by C MuJoCo, which needs no compilation."""

from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjxgrad as mg

_OWN = Path(__file__).parents[2] / "mjcf"
_GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
_HOLD = 10  # steps for which a control is held
_VELOCITY_STDDEV = 0.5  # of the start (m/s or rad/s)


def scene_path(name: str) -> Path:
    """Give the MJCF file of a scene: ours, or gymnasium's."""
    own = _OWN / f"{name}.xml"
    return own if own.exists() else _GYMNASIUM / f"{name}.xml"


def record(
    scene: mg.Scene, *, num_rollouts: int, duration: float, least_steps: int, control_share: float, seed: int
) -> mg.Trajectory:
    """Roll out random controls, held for a few steps, from the reference pose with random velocities.

    Args:
        scene: with nothing of its constraints left out.
        num_rollouts: with different starts and controls.
        duration: of each (s).
        least_steps: of each, where the time step is large.
        control_share: of the range of each control, about its middle.
        seed: of controls and starts.

    Returns:
        The rollouts, stacked.
    """
    model = scene.to_mujoco()
    random = np.random.default_rng(seed)
    horizon = max(round(duration / model.opt.timestep), least_steps)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    middle, reach = (low + high) / 2, control_share * (high - low) / 2
    rollouts = []
    for _ in range(num_rollouts):
        data = mujoco.MjData(model)
        data.qvel[:] = _VELOCITY_STDDEV * random.normal(size=model.nv)
        held = middle + reach * random.uniform(-1, 1, (-(-horizon // _HOLD), model.nu))
        controls = np.repeat(held, _HOLD, axis=0)[:horizon]
        rollouts.append(_roll(scene, model, data, controls))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rollouts)


def _roll(scene: mg.Scene, model: mujoco.MjModel, data: mujoco.MjData, controls: np.ndarray) -> mg.Trajectory:
    qpos, qvel = [data.qpos.copy()], [data.qvel.copy()]
    for row in controls:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
    return mg.Trajectory(
        qpos=jnp.asarray(np.array(qpos)),
        qvel=jnp.asarray(np.array(qvel)),
        ctrl=jnp.asarray(controls),
        observations=None,
        final=mg.initial_state(scene),
        diverged=jnp.array(False),
        first_bad_step=jnp.array(-1, jnp.int32),
    )


def segments(recorded: mg.Trajectory, *, batch: int, horizon: int, seed: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Draw starts from recorded rollouts, with the controls that followed.

    Args:
        recorded: from `record`.
        batch: how many.
        horizon: steps that follow.
        seed: of the choice.

    Returns:
        Positions, velocities and controls, one row per start.
    """
    random = np.random.default_rng(seed)
    which = random.integers(len(recorded.qpos), size=batch)
    when = random.integers(recorded.ctrl.shape[1] - horizon, size=batch)
    follow = when[:, None] + np.arange(horizon)
    return recorded.qpos[which, when], recorded.qvel[which, when], recorded.ctrl[which[:, None], follow]
