"""Rollouts of a scene: its arguments are checked here, and its engine steps it."""

import warnings
from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import ArrayLike, Float, PyTree

from mjxgrad._arrays import function, instance
from mjxgrad.engines import Motion, Observe, Policy, Rows, Sees, State, Trajectory, engine_of
from mjxgrad.rollouts import arguments
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.stepping import Contact, Discrete, Smoothing, smoothing_warnings


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
    contact: Contact = Discrete(),
    inputs: Mapping[str, Float[ArrayLike, "..."]] | None = None,
    checkpoint: bool = True,
    measure_growth: bool = False,
) -> Trajectory:
    """Step a scene many times; return the trajectory, with `horizon + 1` states.

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
            things by name. C MuJoCo gives `sensordata` and the places of bodies, geoms and sites; else there is NaN.
        policy_sees: "state", or "observations": the policy then receives the result of `observe` in place of the state.
            Forces and accelerations are those under the previous control, in the first step under the scene's resting one.
            Observing them takes a second solve per step.
        contact: how contact is stepped: `mg.Discrete()`, `mg.Slope()`, `mg.Onset()` or `mg.Smoothing(...)`, see
            `stepping.contact`. The default is MuJoCo's step, motion and derivative. A `SceneWarning` names the parts of the
            scene that a smoothing does not affect.
        inputs: further inputs of each step, one row per step, by MuJoCo's names: `qfrc_applied`, `xfrc_applied`, `mocap_pos`,
            `mocap_quat`, `eq_active`. Differentiable, except the last. Others stay as in `scene.data`.
        checkpoint: whether to recompute each step in reverse mode from its state and the solutions of its solves. Memory then
            grows by a few numbers per step. False keeps everything: somewhat faster, and hundreds of times larger.
        measure_growth: whether to propagate one tangent, for `growth` and `explodes`: they tell whether the derivatives can
            be trusted. Chattering contacts may multiply derivatives at every switch. It costs as much as a derivative in
            forward mode.

    Raises:
        ValueError: if contact is none of the four records, shapes do not fit the scene, the horizon is missing or contradicted,
            or known controls or noise are not finite (inside `jax.jit` the rollout is flagged as diverged at this step).
    """
    arguments.check_start(scene, state)
    engine = engine_of(scene, contact)
    for message in smoothing_warnings(scene.model) if isinstance(contact, Smoothing) else ():
        warnings.warn(f"{scene.name}: {message}", SceneWarning, stacklevel=2)
    if policy_sees not in ("state", "observations") or (policy_sees == "observations" and observe is None):
        raise ValueError(f'policy_sees must be "state", or "observations" with observe=, got {policy_sees!r}')
    function("observe", observe, "model", "data")
    instance("checkpoint", checkpoint, bool, "True or False")
    policy = controls if callable(controls) else None
    function("policy", policy, "params", "state")
    if policy is None and params is not None:
        raise ValueError("params must belong to a policy, got them beside a sequence of controls: give noise as noise=")
    sequence, horizon = arguments.sequence_of(controls, noise, horizon, scene.model.nu)
    forces = arguments.applied(scene, inputs, horizon)
    base = jnp.broadcast_to(scene.data.ctrl, (horizon, scene.model.nu)) if sequence is None else sequence
    rows = Rows(base, jnp.zeros_like(base) if noise is None else jnp.asarray(noise), forces)
    ways = (policy_sees, checkpoint, contact, measure_growth)
    motion = Motion(scene, policy, params if policy is not None else None, observe, *ways)
    return engine.roll_out(motion, state, rows)
