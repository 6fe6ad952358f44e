"""Fine steps where a contact or limit begins or ends, coarse ones elsewhere."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad._rollout import State, Trajectory, data_of, state_of
from mjxgrad.dynamics import Gradient, assembly, check_gradient, step
from mjxgrad.dynamics.events import contacts_of
from mjxgrad.integration.march import control_rows, march
from mjxgrad.scene import Scene


def substepped_rollout(
    scene: Scene,
    state: State,
    controls: Float[ArrayLike, "_ _"] | None = None,
    *,
    num_substeps: int,
    horizon: int | None = None,
    gradient: Gradient = "discrete",
) -> Trajectory:
    """Roll out, and repeat each step in which a contact or limit begins or ends in short steps.

    A step holds an event if a distance changes its sign, judged by the distances at its beginning and the velocities at its end.
    Contacts that one end of the step does not know (MJX keeps four corners of a mesh) are judged by those that it does.

    Single rollouts only: under `jax.vmap` every member takes the short steps in every step and throws them away.

    Args:
        scene: from `load_scene`.
        state: where to begin.
        controls: one row per step, or None for the scene's resting ones.
        num_substeps: short steps in a step that holds an event, at least 2.
        horizon: number of steps; needed only where no controls are given.
        gradient: "discrete" or "event", see `step`; of coarse and short steps alike.

    Returns:
        The trajectory at the coarse steps.

    Raises:
        ValueError: if there is no such gradient, `num_substeps` is below 2, or horizon and controls do not fit.
    """
    check_gradient(gradient)
    if num_substeps < 2:
        raise ValueError(f"num_substeps must be at least 2, got {num_substeps}: use rollout")
    rows = control_rows(scene, controls, horizon)

    def advance(state: State, control: Float[Array, " nu"], _: Float[Array, ""]) -> State:
        data = data_of(scene, state, control)
        return state_of(substepped_step(scene.model, data, num_substeps=num_substeps, gradient=gradient))

    return march(scene, state, rows, jnp.full(len(rows), scene.model.opt.timestep), advance)


def substepped_step(
    model: mjx.Model, data: mjx.Data, *, num_substeps: int, gradient: Gradient = "discrete"
) -> mjx.Data:
    """Advance by one time step, in short steps if a contact or limit begins or ends in it; see `substepped_rollout`.

    Args:
        model: as for `step`.
        data: the present state.
        num_substeps: short steps in a step that holds an event.
        gradient: as for `step`.

    Returns:
        Data whose state is one time step later. Its other fields are those of the last step taken, long or short.
    """
    after = step(model, data, gradient=gradient)
    short = model.tree_replace({"opt.timestep": model.opt.timestep / num_substeps})

    def refine(data: mjx.Data) -> mjx.Data:
        def substep(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            return step(short, data, gradient=gradient), None  # pyright: ignore[reportArgumentType]

        return jax.lax.scan(substep, data, length=num_substeps)[0]

    return jax.lax.cond(_holds_event(model, data, after), refine, lambda _: after, data)


def _holds_event(model: mjx.Model, before: mjx.Data, after: mjx.Data) -> Bool[Array, ""]:
    """Whether some distance changes its sign in a step."""
    # Contacts and kinematics of a stepped data are those of the state before; its position is not.
    blocks = assembly.gather(model, after.replace(qpos=before.qpos))
    if not any(block.rows_each for block in blocks):
        return jnp.zeros((), bool)
    distance, normal = contacts_of(blocks)
    later = distance + model.opt.timestep * normal @ after.qvel
    return jnp.any((distance < 0) != (later < 0))
