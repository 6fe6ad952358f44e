"""Fine steps where a contact or limit begins or ends, coarse ones elsewhere."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from mjxgrad._mjx import mjx
from mjxgrad.dynamics import Gradient, assembly, check_gradient, step
from mjxgrad.integration.march import control_rows, data_of, march, state_of
from mjxgrad.rollout import State, Trajectory
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
    Contacts that one end of the step does not know (MJX keeps four of a box's corners) are judged by those that it does.

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
    short = scene.model.tree_replace({"opt.timestep": scene.model.opt.timestep / num_substeps})

    def advance(state: State, control: Float[Array, " nu"], _: Float[Array, ""]) -> State:
        before = data_of(scene, state, control)
        after = step(scene.model, before, gradient=gradient)

        def refine(start: State) -> State:
            def substep(state: State, _: None) -> tuple[State, None]:
                return state_of(step(short, data_of(scene, state, control), gradient=gradient)), None  # pyright: ignore[reportArgumentType]

            return jax.lax.scan(substep, start, length=num_substeps)[0]

        return jax.lax.cond(_holds_event(scene.model, before, after), refine, lambda _: state_of(after), state)

    return march(scene, state, rows, jnp.full(len(rows), scene.model.opt.timestep), advance)


def _holds_event(model: mjx.Model, before: mjx.Data, after: mjx.Data) -> Bool[Array, ""]:
    """Whether some distance changes its sign in a step."""
    # Contacts and kinematics of a stepped data are those of the state before; its position is not.
    blocks = assembly.gather(model, after.replace(qpos=before.qpos))
    found = [jnp.zeros((), bool)]
    for block in blocks:
        if not block.rows_each:
            continue
        # Of a pyramid's edges the mean is the normal, of a cone's rows the first.
        jacobian = block.jacobian.reshape(-1, block.rows_each, model.nv)
        normal = jnp.mean(jacobian, axis=1) if block.is_pyramid else jacobian[:, 0]
        distance = block.residual[:: block.rows_each]
        later = distance + model.opt.timestep * normal @ after.qvel
        found.append(jnp.any((distance < 0) != (later < 0)))
    return jnp.any(jnp.stack(found))
