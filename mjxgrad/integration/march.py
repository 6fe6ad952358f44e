"""A scan over steps that need not be equal; what the other ways to step share."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from mjxgrad._rollout import State, Trajectory, is_sound
from mjxgrad.dynamics.implicit import CHECKPOINT_NAME
from mjxgrad.scene import Scene

Advance = Callable[[State, Float[Array, " nu"], Float[Array, ""]], State]


def march(
    scene: Scene,
    state: State,
    controls: Float[Array, "steps nu"],
    durations: Float[Array, " steps"],
    advance: Advance,
    *,
    velocity_limit: float = 1e4,
) -> Trajectory:
    """Advance a state over given durations, checkpointed; see `rollout` for the result.

    Args:
        scene: what moves.
        state: where it begins.
        controls: one row per step.
        durations: of the steps, in s.
        advance: from state, control and duration to the next state.
        velocity_limit: a generalised speed beyond it counts as diverged (m/s, rad/s).
    """

    def body(
        carry: tuple[State, Int[Array, ""]], inputs: tuple[Array, Array, Array]
    ) -> tuple[tuple[State, Int[Array, ""]], tuple[Array, Array]]:
        state, first_bad = carry
        index, control, duration = inputs
        moved = advance(state, control, duration)
        first_bad = jnp.where((first_bad < 0) & ~is_sound(moved, velocity_limit), index, first_bad)
        kept = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, moved)
        return (kept, first_bad), (state.qpos, state.qvel)

    keep = jax.checkpoint_policies.save_only_these_names(CHECKPOINT_NAME)
    body = jax.checkpoint(body, policy=keep, prevent_cse=False)
    inputs = (jnp.arange(len(durations), dtype=jnp.int32), controls, durations)
    (final, first_bad), (qpos, qvel) = jax.lax.scan(body, (state, jnp.full((), -1, jnp.int32)), inputs)
    return Trajectory(
        qpos=jnp.concatenate([qpos, final.qpos[None]]),
        qvel=jnp.concatenate([qvel, final.qvel[None]]),
        ctrl=controls,
        observations=None,
        final=final,
        diverged=first_bad >= 0,
        first_bad_step=first_bad,
    )


def control_rows(scene: Scene, controls: Float[ArrayLike, "_ _"] | None, horizon: int | None) -> Float[Array, "n nu"]:
    """Give one row of controls per step.

    Args:
        scene: gives the resting ones.
        controls: as given, or None.
        horizon: number of steps, or None if the controls give it.

    Raises:
        ValueError: if the number of steps is missing, contradicted or below 1, or the rows do not fit the scene.
    """
    nu = scene.model.nu
    if controls is None:
        if horizon is None or horizon < 1:
            raise ValueError(f"horizon must be at least 1 where no controls are given, got {horizon}")
        return jnp.broadcast_to(scene.data.ctrl, (horizon, nu))
    rows = jnp.asarray(controls, scene.data.ctrl.dtype)
    if rows.shape[1] != nu or not len(rows) or horizon not in (None, len(rows)):
        wanted = f"({horizon or 'steps'}, {nu})"
        raise ValueError(f"controls must have shape {wanted}, one row per step, got {rows.shape}")
    return rows
