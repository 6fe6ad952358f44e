"""A rollout by MJX: one checkpointed scan with a small carry, and failure flags."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, PyTree

from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.contact.collision import first_missed, slot_geoms
from mjxgrad.rollouts.arguments import Observe, Policy, Sees, one_each
from mjxgrad.rollouts.state import State, data_of, direction, is_sound, state_of
from mjxgrad.rollouts.trajectory import Trajectory
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import numbers_of
from mjxgrad.stepping import Contact, Onset, Smoothing, forward, step
from mjxgrad.stepping.onset import reach


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


class Scan(eqx.Module):
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
            state,
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
        is_bad = ~is_sound(moved)
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


def rolled_out(scan: Scan, state: State, rows: tuple[Array, Array, dict[str, Array]]) -> Trajectory:
    """Return the result of `rollout` for checked arguments; `rows` are controls, noise and inputs of each step."""
    advance = functools.partial(Scan.advance, scan)  # a bound method of a pytree has no hash
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


rolled_out_compiled = compiled(rolled_out)


def _is_crowded(model: mjx.Model, data: mjx.Data, contact: Contact) -> Bool[Array, ""]:
    """Return whether contacts may have acted without a slot in the step behind this data."""
    if not data._impl.ncon or slot_geoms(model, data) is not None:
        return jnp.array(False)
    if isinstance(contact, Smoothing):
        return jnp.array(True)
    return first_missed(model, data) < (reach(model, data, contact) if isinstance(contact, Onset) else 0.0)
