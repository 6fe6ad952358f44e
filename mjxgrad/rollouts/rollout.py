"""Rollouts of a scene by either engine.

MJX's is one checkpointed scan with a small carry, and failure flags. C MuJoCo's runs on all cores of the processor, without
compilation, differentiable once.
"""

import dataclasses
import functools
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from mjxgrad._arrays import function, instance
from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled, is_traced
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.contact.collision import first_missed, slot_geoms
from mjxgrad.engines import roll_out
from mjxgrad.rollouts import arguments
from mjxgrad.rollouts.arguments import Observe, Policy, Sees, one_each
from mjxgrad.rollouts.observation import observed
from mjxgrad.rollouts.state import Pairs, State, Trajectory, complete, data_of, direction, is_sound, state_of
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.scene.scene import numbers_of
from mjxgrad.stepping import Contact, Discrete, Gradient, Onset, Smoothing, forward, smoothing_warnings, step
from mjxgrad.stepping.onset import reach

_Inputs = dict[str, Array]


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
    native = arguments.native_motion(scene, contact)
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
    if native is not None:
        added = jnp.zeros(base.shape, state.qvel.dtype) if noise is None else jnp.asarray(noise)
        given = (base + added if policy is None else policy, params, added, forces, native.gradient)
        looks = {"observe": observe, "policy_sees": policy_sees}
        return _by_mujoco(scene, state, *given, **looks, measure_growth=measure_growth)
    rows = (base, jnp.zeros_like(base) if noise is None else jnp.asarray(noise), forces)
    ways = (policy_sees, checkpoint, contact, measure_growth)
    scan = _Scan(scene, policy, params if policy is not None else None, observe, *ways)
    # Functions may read changing variables: every call traces them anew, unless the caller compiles.
    has_functions = policy is not None or observe is not None
    is_part = has_functions or is_traced((scan, state, rows))
    return (_by_mjx if is_part else _by_mjx_compiled)(scan, state, rows)


class _Carry(NamedTuple):
    """The carry of the scan: the last good state, what to count as in `Trajectory`, and the tangent that measures growth.

    `before` is the previous control, under which a policy observes; None for a policy that sees the state.
    """

    state: State
    before: Array | None
    first_bad: Array
    unsolved: Array
    crowded: Array
    tangent: tuple[Array, Array] | None
    growth: Array | None


class _Scan(eqx.Module):
    """The loop over the steps of one rollout; its fields are arguments of `rollout`, by the same names."""

    scene: Scene
    policy: Policy | None
    params: PyTree
    observe: Observe | None
    policy_sees: Sees
    checkpoint: bool
    contact: Contact
    measure_growth: bool

    def begin(self, state: State) -> _Carry:
        """Return the carry of the first step."""
        looks = self.policy is not None and self.policy_sees == "observations"
        # A NaN in the contacts of a traced model would go unnoticed.
        traced = [x for x in numbers_of(self.scene.model).values() if isinstance(x, jax.core.Tracer)]
        has_numbers = ~jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in traced])) if traced else jnp.array(True)
        return _Carry(
            dataclasses.replace(state, pairs=None),
            self.scene.data.ctrl if looks else None,
            jnp.where(has_numbers, jnp.int32(-1), jnp.int32(0)),
            jnp.zeros((), jnp.int32),
            jnp.zeros((), jnp.int32),
            direction(state) if self.measure_growth else None,
            jnp.ones((), state.qvel.dtype) if self.measure_growth else None,
        )

    def advance(self, carry: _Carry, given: tuple[Array, Array, Array, dict]) -> tuple[_Carry, tuple]:
        """Take one step, and return the next carry and the outputs of this step."""
        state, model = carry.state, self.scene.model
        index, row, disturbance, forces = given
        seen = None if carry.before is None else self.look(state, carry.before, forces)
        if self.policy is not None:
            row = one_each(self.policy(self.params, state if carry.before is None else seen), model.nu)
        ctrl = row + disturbance
        data = data_of(self.scene, state, ctrl).replace(**forces)
        tangent, growth = carry.tangent, carry.growth
        if tangent is None or growth is None:
            stepped = step(model, data, contact=self.contact)
        else:
            stepped, tangent, growth = self.measure(data, tangent, growth)
        moved = state_of(stepped)
        is_bad = ~is_sound(moved.qpos, moved.qvel, moved.act)
        first_bad = jnp.where((carry.first_bad < 0) & is_bad, index, carry.first_bad)
        following = _Carry(
            jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, moved),
            None if carry.before is None else ctrl.astype(carry.before.dtype),
            first_bad,
            carry.unsolved + ((first_bad < 0) & (stepped._impl.solver_niter > model.opt.iterations)),
            carry.crowded + ((first_bad < 0) & _is_crowded(model, jax.lax.stop_gradient(stepped), self.contact)),
            tangent,
            growth,
        )
        return following, (state.qpos, state.qvel, state.act, ctrl, self.look(state, ctrl, forces, stepped), seen)

    def measure(self, data: mjx.Data, tangent: tuple, growth: Array) -> tuple[mjx.Data, tuple[Array, Array], Array]:
        """Return the data after a step, the tangent there, and its largest norm so far."""

        def motion(qpos: Array, qvel: Array) -> tuple[tuple[Array, Array], mjx.Data]:
            stepped = step(self.scene.model, data.replace(qpos=qpos, qvel=qvel), contact=self.contact)
            return (stepped.qpos, stepped.qvel), stepped

        _, change, stepped = jax.jvp(motion, (data.qpos, data.qvel), tangent, has_aux=True)
        change = jax.lax.stop_gradient(change)
        return stepped, change, jnp.maximum(growth, jnp.linalg.norm(jnp.concatenate(change)))  # a NaN stays one

    def look(self, state: State, ctrl: Array, forces: dict, stepped: mjx.Data | None = None) -> PyTree:
        """Return the observations in a state under a control, from the data of a step where it is given."""
        if self.observe is None:
            return None
        model, data = self.scene.model, data_of(self.scene, state, ctrl).replace(**forces)
        has_stages = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        if stepped is None or has_stages:  # data of a multi-stage step belongs to its last stage
            return self.observe(model, forward(model, data, contact=self.contact))
        at_start = {name: getattr(data, name) for name in ("qpos", "qvel", "act", "time")}
        return self.observe(model, stepped.replace(**at_start))


def _by_mjx(scan: _Scan, state: State, rows: tuple[Array, Array, dict[str, Array]]) -> Trajectory:
    """Return the result of `rollout` for checked arguments; `rows` are controls, noise and inputs of each step."""
    advance = functools.partial(_Scan.advance, scan)  # a bound method of a pytree has no hash
    if scan.checkpoint:
        keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
        # Inside a scan prevent_cse is needless: XLA cannot merge the recomputation with the forward pass.
        advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
    first, steps = scan.begin(state), jnp.arange(len(rows[0]), dtype=jnp.int32)
    end, (qpos, qvel, act, ctrl, observed, seen) = jax.lax.scan(advance, first, (steps, *rows))
    final, growth = end.state, end.growth
    if scan.observe is not None:
        last = scan.look(final, ctrl[-1], jax.tree.map(lambda x: x[-1], rows[2]))
        observed = jax.tree.map(lambda x, y: jnp.concatenate([x, jnp.asarray(y)[None]]), observed, last)
    return Trajectory(
        qpos=jnp.concatenate([qpos, final.qpos[None]]),
        qvel=jnp.concatenate([qvel, final.qvel[None]]),
        ctrl=ctrl,
        observations=observed,
        final=final,
        diverged=end.first_bad >= 0,
        first_bad_step=end.first_bad,
        unsolved=end.unsolved,
        crowded=end.crowded,
        growth=None if growth is None else jnp.where(jnp.isnan(growth), jnp.inf, growth),
        act=jnp.concatenate([act, final.act[None]]),
        seen=seen,
    )


_by_mjx_compiled = compiled(_by_mjx)


def _is_crowded(model: mjx.Model, data: mjx.Data, contact: Contact) -> Bool[Array, ""]:
    """Return whether contacts may have acted without a slot in the step behind this data."""
    if not data._impl.ncon or slot_geoms(model, data) is not None:
        return jnp.array(False)
    if isinstance(contact, Smoothing):
        return jnp.array(True)
    return first_missed(model, data) < (reach(model, data, contact) if isinstance(contact, Onset) else 0.0)


def _by_mujoco(
    scene: Scene,
    state: State,
    controls: Policy | Float[Array, "horizon nu"],
    params: PyTree,
    noise: Float[Array, "horizon nu"],
    inputs: _Inputs,
    gradient: Gradient,
    *,
    observe: Observe | None,
    policy_sees: Sees,
    measure_growth: bool,
) -> Trajectory:
    """Return C MuJoCo's rollout under controls, noise included, or a policy; the last good state is held."""
    given, state, seen = state, complete(scene, state), None
    if not callable(controls):
        found = _course(scene, state, controls, inputs, gradient)
    else:
        looks = policy_sees == "observations"

        def advance(carry: tuple[State, Array, Array], given: tuple[Array, Array, _Inputs]) -> tuple:
            state, first_bad, before = carry
            index, disturbance, row = given
            seen = observed(scene, state, before, row, observe) if looks and observe is not None else None
            ctrl = one_each(controls(params, seen if looks else state), scene.model.nu) + disturbance
            one, _ = _course(scene, state, ctrl[None], jax.tree.map(lambda x: x[None], row), gradient)
            first_bad = jnp.where((first_bad < 0) & one.diverged, index, first_bad)
            moved = jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, one.final)
            return (moved, first_bad, ctrl.astype(before.dtype)), (
                (state.qpos, state.qvel, state.act, state.history),
                ctrl,
                seen,
            )

        # Step by step, since each control depends on the state before it.
        rows = (jnp.arange(len(noise), dtype=jnp.int32), noise, inputs)
        first = (state, jnp.int32(-1), scene.data.ctrl)
        (final, first_bad, _), (states, ctrl, seen) = jax.lax.scan(advance, first, rows)
        last = (final.qpos, final.qvel, final.act, final.history)
        states = [jnp.concatenate([x, end[None]]) for x, end in zip(states, last, strict=True)]
        found = _trajectory(states, final, ctrl, first_bad), states[3]
    found, history = found
    growth = _growth(scene, state, found.ctrl, inputs, gradient) if measure_growth else None
    observations = None
    if observe is not None:
        observations = _observations(scene, state, found, history, inputs, observe)
    # What a scan carries has to look as it did.
    final = found.final if given.pairs is not None else dataclasses.replace(found.final, pairs=None)
    final = final if given.history.size == final.history.size else dataclasses.replace(final, history=given.history)
    return dataclasses.replace(found, growth=growth, final=final, observations=observations, seen=seen)


def _observations(
    scene: Scene, start: State, found: Trajectory, history: Float[Array, "states _"], inputs: _Inputs, observe: Observe
) -> PyTree:
    """Return what is observed in each state of a motion, the last one under the last control."""
    assert found.act is not None
    steps = jnp.minimum(jnp.arange(len(found.qpos)), len(found.ctrl) - 1)
    time = start.time + scene.model.opt.timestep * jnp.arange(len(found.qpos))
    states = jax.vmap(State)(found.qpos, found.qvel, found.act, time, jnp.zeros_like(found.qvel), history)
    look = lambda state, ctrl, row: observed(scene, state, ctrl, row, observe)  # noqa: E731
    return jax.vmap(look)(states, found.ctrl[steps], jax.tree.map(lambda x: x[steps], inputs))


@eqx.filter_jit
def _course(
    scene: Scene, state: State, ctrl: Float[Array, "horizon nu"], inputs: _Inputs, gradient: Gradient
) -> tuple[Trajectory, Float[Array, "states _"]]:
    """Return the motion under known controls, and what else goes on: one call of C MuJoCo."""
    is_finite = jnp.isfinite(ctrl)  # MuJoCo replaces others by zero
    start, resting = arguments.arguments_of(scene, state)
    assert state.pairs is not None
    start |= {"warmstart": state.warmstart, "flight": state.pairs.flight, "held": state.pairs.held}
    given = {name: jnp.broadcast_to(value, (len(ctrl), *value.shape)) for name, value in resting.items()}
    found = roll_out(scene, start, given | inputs | {"ctrl": jnp.where(is_finite, ctrl, 0.0)}, gradient)
    qpos, qvel, act = (jnp.concatenate([getattr(state, k)[None], found[k]]) for k in ("qpos", "qvel", "act"))
    history = jnp.concatenate([state.history[None], jnp.concatenate([found["history"], found["plugin"]], axis=1)])
    is_good = jax.vmap(is_sound)(qpos, qvel, act)
    is_bad = ~(is_good[1:] & jnp.all(is_finite, axis=1))
    first_bad = jnp.where(jnp.any(is_bad), jnp.argmax(is_bad).astype(jnp.int32), -1)
    kept = jnp.arange(len(ctrl) + 1)
    kept = jnp.where(first_bad >= 0, jnp.minimum(kept, first_bad), kept)
    qpos, qvel, act, history = (x[kept] for x in (qpos, qvel, act, history))
    time = state.time + scene.model.opt.timestep * kept[-1]
    pairs = Pairs(found["flight"], found["held"])
    pairs = jax.tree.map(lambda x: jnp.where(first_bad >= 0, 0.0, x), pairs)
    final = State(qpos[-1], qvel[-1], act[-1], time, found["warmstart"], history[-1], pairs)
    return _trajectory((qpos, qvel, act), final, ctrl, first_bad), history


def _trajectory(
    states: Sequence[Array], final: State, ctrl: Float[Array, "horizon nu"], first_bad: Int[Array, ""]
) -> Trajectory:
    qpos, qvel, act, *_ = states
    return Trajectory(qpos, qvel, ctrl, None, final, first_bad >= 0, first_bad, act=act)  # pyright: ignore[reportCallIssue]


def _growth(scene: Scene, state: State, ctrl: Array, inputs: _Inputs, gradient: Gradient) -> Float[Array, ""]:
    """Return the growth of a tangent of the start; it has no derivative."""
    fixed = lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x  # noqa: E731
    scene, state, ctrl, inputs = jax.tree.map(fixed, (scene, state, ctrl, inputs))

    def course(qpos: Array, qvel: Array) -> tuple[Array, Array]:
        found, _ = _course(scene, dataclasses.replace(state, qpos=qpos, qvel=qvel), ctrl, inputs, gradient)
        return found.qpos, found.qvel

    _, change = jax.jvp(course, (state.qpos, state.qvel), direction(state))
    size = jnp.linalg.norm(jnp.concatenate(change, axis=1), axis=1).max()
    return jnp.where(jnp.isfinite(size), jnp.maximum(size, 1.0), jnp.inf)
