"""Many steps of a scene, by either engine."""

import warnings
from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import ArrayLike, Float, PyTree

from mjxgrad.rollouts import by_mjx, by_mujoco
from mjxgrad.rollouts.arguments import (
    Engine,
    Observe,
    Policy,
    Sees,
    applied,
    check_engine,
    check_policy_sees,
    check_shapes,
    sequence_of,
)
from mjxgrad.rollouts.state import State, check_scene
from mjxgrad.rollouts.trajectory import Trajectory
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.stepping import Gradient, Onset, Smoothing, check_gradient, smoothing_warnings


def rollout(
    scene: Scene,
    state: State,
    controls: Float[ArrayLike, "_ _"] | Policy | None = None,
    params: PyTree = None,
    noise: Float[ArrayLike, "_ _"] | None = None,
    *,
    horizon: int | None = None,
    observe: Observe | None = None,
    policy_sees: Sees = "state",
    checkpoint: bool = True,
    gradient: Gradient = "discrete",
    onset: Onset | None = None,
    smoothing: Smoothing | None = None,
    velocity_limit: float | None = 1e4,
    measure_growth: bool = False,
    inputs: Mapping[str, Float[ArrayLike, "..."]] | None = None,
    engine: Engine | None = None,
) -> Trajectory:
    """Step a scene many times.

    Batches are `jax.vmap` over any argument. Differentiable both ways; a rollout that diverged has no meaningful
    derivative, and `diverged` says so.

    Args:
        scene: from `load_scene`.
        state: where to begin, from `initial_state` or the end of another rollout.
        controls: one row per step; or a policy, called as `policy(params, state)`; or None for the scene's resting ones.
            Beyond an actuator's `ctrlrange` a control has the effect of its end, and derivative zero.
        params: handed to the policy.
        noise: added to the controls, one row per step.
        horizon: number of steps; needed only where neither controls nor noise give it.
        observe: called as `observe(model, data)` with the data of every state, all positions, contacts and forces filled
            in; its results are stacked. Name what you need: what it does not return is not kept. `mg.sensor`,
            `mg.site_position` and `mg.contact_force` read things by name.
        policy_sees: "state", or "observations": the policy is then called with what `observe` returns in place of the state.
            It looks before it chooses: forces and accelerations are those under the control before, in the first step under the
            scene's resting one. This takes a second solve per step where they are observed.
        checkpoint: recompute each step in reverse mode and keep only its state and the solutions of its solves, so that memory
            grows by a few numbers per step. Off, everything is kept: somewhat faster, and hundreds of times larger.
        gradient: "discrete", the derivative of each step, which finite differences of it give; or "slope", which knows that
            contacts and limits begin and end at times that move, so that its mean is the slope of the outcome. The motion is the
            same. Of C MuJoCo's step see `native.events`, of MJX's `step`.
        onset: lets contacts and limits begin within the step, see `step`: a continuous motion, whose plain derivative is the
            slope. None is MuJoCo's motion, to the bit.
        smoothing: averages the contacts of each step over noise on their distance, see `step`. It is said by a
            `SceneWarning` what of the scene it has no effect on.
        velocity_limit: a generalised speed beyond it counts as diverged (m/s, rad/s); None switches this off.
        measure_growth: carry one tangent along and tell by `growth` and `explodes` whether derivatives of this rollout can be
            believed: contacts that chatter may multiply them at every switch. It takes as long as a derivative in forward mode.
        inputs: what else is given to each step, one row per step, by MuJoCo's names: `qfrc_applied`, `xfrc_applied`,
            `mocap_pos`, `mocap_quat`, `eq_active`. Differentiable, but for the last. What is not named stays as in `scene.data`.
        engine: "mjx" or "mujoco": C MuJoCo on all cores of the processor, with nothing to compile, differentiable once. Its
            motion has no onset, to the solver's tolerance; what has no meaning there is refused. None is the scene's own,
            `scene.engine`.

    Returns:
        The trajectory, with `horizon + 1` states.

    Raises:
        ValueError: if there is no such gradient, it does not go with onset or smoothing, shapes do not fit the scene, the
            horizon is missing or contradicted, or controls or noise hold numbers that are not finite (checked where
            values are known, that is outside `jax.jit`; inside, the rollout is flagged as diverged at that step).
    """
    check_scene(scene)
    if not isinstance(state, State):
        raise ValueError(f"state must be of mg.initial_state, or the end of a rollout, got {type(state).__name__}")
    check_gradient(gradient, onset, smoothing)
    for message in [] if smoothing is None else smoothing_warnings(smoothing, scene.model):
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    check_policy_sees(policy_sees, observe)
    policy = controls if callable(controls) else None
    sequence, horizon = sequence_of(controls, noise, horizon, scene.model.nu)
    check_shapes(scene, state)
    forces = applied(scene, inputs, horizon)
    base = jnp.broadcast_to(scene.data.ctrl, (horizon, scene.model.nu)) if sequence is None else sequence
    engine = scene.engine if engine is None else engine
    if engine != "mjx":
        check_engine(engine, observe=observe, onset=onset, smoothing=smoothing)
        added = jnp.zeros(base.shape, state.qvel.dtype) if noise is None else jnp.asarray(noise)
        given = (base + added if policy is None else policy, params, added, forces, gradient, velocity_limit)
        return by_mujoco.rolled_out(scene, state, *given, measure_growth=measure_growth)
    scene.check_mjx()
    rows = (base, jnp.zeros_like(base) if noise is None else jnp.asarray(noise), forces)
    settings = by_mjx.Settings(policy_sees, checkpoint, gradient, onset, smoothing, velocity_limit, measure_growth)
    # Functions may read what changes from call to call: they are traced anew in each, unless the caller compiles.
    if policy is None and observe is None:
        return by_mjx.rolled_out_compiled(scene, state, rows, None, None, None, settings)
    return by_mjx.rolled_out(scene, state, rows, policy, params, observe, settings)
