"""A rollout by MJX: one scan with a lean carry, checkpointed, that says when it has gone wrong."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.contact.collision import first_missed, slot_geoms
from mjxgrad.rollouts.arguments import Observe, Policy, Sees, one_each
from mjxgrad.rollouts.state import State, data_of, direction, is_sound, state_of
from mjxgrad.rollouts.trajectory import Trajectory
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import numbers_of
from mjxgrad.stepping import Gradient, Onset, Smoothing, forward, step
from mjxgrad.stepping.onset import reach


class Settings(NamedTuple):
    """How steps are taken, looked at and kept: arguments of `rollout`, by the same names."""

    policy_sees: Sees
    checkpoint: bool
    gradient: Gradient
    onset: Onset | None
    smoothing: Smoothing | None
    velocity_limit: float | None
    measure_growth: bool


class _Carry(NamedTuple):
    """What goes from step to step.

    Attributes:
        state: the last good one.
        before: the control before, under which a policy looks; None for one that sees the state.
        first_bad: the first bad step, −1 so far.
        unsolved: steps whose solve was cut short.
        crowded: steps with too little room for contacts.
        tangent: the change of positions and velocities by which growth is measured.
        growth: the largest size of it.
    """

    state: State
    before: Array | None
    first_bad: Array
    unsolved: Array
    crowded: Array
    tangent: tuple[Array, Array] | None
    growth: Array | None


@dataclasses.dataclass(frozen=True, eq=False)
class _Scan:
    """The loop over the steps of one rollout."""

    scene: Scene
    policy: Policy | None
    params: PyTree
    observe: Observe | None
    settings: Settings

    def begin(self, state: State) -> _Carry:
        """Return what the first step is given."""
        looks = self.policy is not None and self.settings.policy_sees == "observations"
        return _Carry(
            state,
            self.scene.data.ctrl if looks else None,
            jnp.where(_has_numbers(self.scene), jnp.int32(-1), jnp.int32(0)),
            jnp.zeros((), jnp.int32),
            jnp.zeros((), jnp.int32),
            direction(state) if self.settings.measure_growth else None,
            jnp.ones((), state.qvel.dtype) if self.settings.measure_growth else None,
        )

    def advance(self, carry: _Carry, given: tuple[Array, Array, Array, dict]) -> tuple[_Carry, tuple]:
        """Take one step, and return with the next carry what of this one is kept."""
        state, model, settings = carry.state, self.scene.model, self.settings
        index, row, disturbance, forces = given
        seen = None if carry.before is None else self.look(state, carry.before, forces)
        ctrl = (row if self.policy is None else self.choose(state if carry.before is None else seen)) + disturbance
        data = data_of(self.scene, state, ctrl).replace(**forces)
        stepped, tangent, growth = self.take(data, carry.tangent, carry.growth)
        moved = state_of(stepped)
        is_bad = ~is_sound(moved, settings.velocity_limit)
        first_bad = jnp.where((carry.first_bad < 0) & is_bad, index, carry.first_bad)
        following = _Carry(
            jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), state, moved),
            None if carry.before is None else ctrl.astype(carry.before.dtype),
            first_bad,
            carry.unsolved + ((first_bad < 0) & (stepped._impl.solver_niter > model.opt.iterations)),
            carry.crowded + ((first_bad < 0) & _is_crowded(model, jax.lax.stop_gradient(stepped), settings)),
            tangent,
            growth,
        )
        return following, (state.qpos, state.qvel, state.act, ctrl, self.look(state, ctrl, forces, stepped), seen)

    def choose(self, seen: PyTree) -> Float[Array, " nu"]:
        """Return the controls that the policy chooses."""
        return one_each(self.policy(self.params, seen), self.scene.model.nu)  # pyright: ignore[reportOptionalCall]

    def take(self, data: mjx.Data, tangent: tuple | None, growth: Array | None) -> tuple[mjx.Data, Any, Array | None]:
        """Return the data after a step, and the tangent there with the largest size that it has had."""
        settings, model = self.settings, self.scene.model
        how = {"gradient": settings.gradient, "onset": settings.onset, "smoothing": settings.smoothing}
        if tangent is None or growth is None:
            return step(model, data, **how), None, None

        def motion(qpos: Array, qvel: Array) -> tuple[tuple[Array, Array], mjx.Data]:
            stepped = step(model, data.replace(qpos=qpos, qvel=qvel), **how)
            return (stepped.qpos, stepped.qvel), stepped

        _, change, stepped = jax.jvp(motion, (data.qpos, data.qvel), tangent, has_aux=True)
        change = jax.lax.stop_gradient(change)
        return stepped, change, jnp.maximum(growth, jnp.linalg.norm(jnp.concatenate(change)))  # a NaN stays one

    def look(self, state: State, ctrl: Array, forces: dict, stepped: mjx.Data | None = None) -> PyTree:
        """Return what is observed in a state under a control; of what a step has left, if it is given."""
        if self.observe is None:
            return None
        model, data = self.scene.model, data_of(self.scene, state, ctrl).replace(**forces)
        has_stages = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        if stepped is None or has_stages:  # what a step of several stages leaves is of its last
            return self.observe(
                model, forward(model, data, onset=self.settings.onset, smoothing=self.settings.smoothing)
            )
        at_start = {name: getattr(data, name) for name in ("qpos", "qvel", "act", "time")}
        return self.observe(model, stepped.replace(**at_start))


def rolled_out(
    scene: Scene,
    state: State,
    rows: tuple[Array, Array, dict[str, Array]],
    policy: Policy | None,
    params: PyTree,
    observe: Observe | None,
    settings: Settings,
) -> Trajectory:
    """Return what `rollout` does, once all of its arguments are known to be right.

    Args:
        scene: where it happens.
        state: where it begins.
        rows: controls, noise and inputs of each step.
        policy: what chooses controls in place of the rows, if anything.
        params: of the policy.
        observe: what to keep of every state.
        settings: how.
    """
    scan = _Scan(scene, policy, params, observe, settings)
    advance = scan.advance
    if settings.checkpoint:
        keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
        # Inside a scan nothing can be merged across the barrier that prevent_cse would put up.
        advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
    first, steps = scan.begin(state), jnp.arange(len(rows[0]), dtype=jnp.int32)
    end, (qpos, qvel, act, ctrl, observed, seen) = jax.lax.scan(advance, first, (steps, *rows))
    final, growth = end.state, end.growth
    if observe is not None:
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


rolled_out_compiled = compiled(rolled_out)


def _has_numbers(scene: Scene) -> Bool[Array, ""]:
    """Whether what only the running program knows of a model are numbers: a contact of NaN would not be felt at all."""
    traced = [x for x in numbers_of(scene.model).values() if isinstance(x, jax.core.Tracer)]
    return jnp.array(True) if not traced else ~jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in traced]))


def _is_crowded(model: mjx.Model, data: mjx.Data, settings: Settings) -> Bool[Array, ""]:
    """Return whether, in the step that the data is from, contacts may have acted that found no slot."""
    if not data._impl.ncon or slot_geoms(model, data) is not None:
        return jnp.array(False)
    if settings.smoothing is not None:
        return jnp.array(True)
    return first_missed(model, data) < (0.0 if settings.onset is None else reach(model, data, settings.onset))
