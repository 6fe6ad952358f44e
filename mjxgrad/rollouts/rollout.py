"""Rollouts of a scene, by either engine."""

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

    Batches are `jax.vmap` over any argument. Differentiable in forward and reverse mode. A diverged rollout has no meaningful
    derivative; its flag `diverged` is set.

    Args:
        scene: from `load_scene`.
        state: the initial state, from `initial_state` or the end of another rollout.
        controls: one row per step; or a policy, called as `policy(params, state)`; or None for the scene's resting ones.
            MuJoCo clips a control at `ctrlrange`; beyond it the derivative is zero.
        params: parameters of the policy.
        noise: noise on the controls, one row per step.
        horizon: number of steps; needed only where neither controls nor noise determine it.
        observe: called as `observe(model, data)` with the complete data of every state, including contacts and forces; its
            results are stacked, and only these are kept. `mg.sensor`, `mg.site_position` and `mg.contact_force` read
            things by name.
        policy_sees: "state", or "observations": the policy then receives the result of `observe` in place of the state.
            Forces and accelerations are those under the previous control, in the first step under the scene's resting one.
            Observing them takes a second solve per step.
        checkpoint: whether to recompute each step in reverse mode from its state and the solutions of its solves. Memory then
            grows by a few numbers per step. False keeps everything: somewhat faster, and hundreds of times larger.
        gradient: "discrete", the derivative of each step, equal to its finite differences; or "slope", which includes the
            moving times of contact and limit events, so that its mean is the slope of the outcome. The motion is the same.
            See `native.events` for C MuJoCo, `step` for MJX.
        onset: onset of contacts and limits within the step, see `step`: a continuous motion, whose plain derivative is the
            slope. None is MuJoCo's motion, to the bit.
        smoothing: average of the contacts of each step over noise on their distance, see `step`. A `SceneWarning` names the
            parts of the scene that it does not affect.
        velocity_limit: largest generalised speed (m/s, rad/s); beyond it a rollout counts as diverged. None for no limit.
        measure_growth: whether to propagate one tangent, for `growth` and `explodes`: they tell whether the derivatives can
            be trusted. Chattering contacts may multiply derivatives at every switch. It costs as much as a derivative in
            forward mode.
        inputs: further inputs of each step, one row per step, by MuJoCo's names: `qfrc_applied`, `xfrc_applied`, `mocap_pos`,
            `mocap_quat`, `eq_active`. Differentiable, except the last. Others stay as in `scene.data`.
        engine: "mjx"; or "mujoco", C MuJoCo on all cores of the processor, without compilation, differentiable once. The
            motions agree to the solver's tolerance, without onset; settings that C MuJoCo lacks are refused. None is the
            scene's own, `scene.engine`.

    Returns:
        The trajectory, with `horizon + 1` states.

    Raises:
        ValueError: if there is no such gradient, it does not go with onset or smoothing, shapes do not fit the scene, the
            horizon is missing or contradicted, or known controls or noise are not finite (inside `jax.jit` the rollout is
            flagged as diverged at this step).
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
    # Functions may read changing variables: every call traces them anew, unless the caller compiles.
    if policy is None and observe is None:
        return by_mjx.rolled_out_compiled(scene, state, rows, None, None, None, settings)
    return by_mjx.rolled_out(scene, state, rows, policy, params, observe, settings)
