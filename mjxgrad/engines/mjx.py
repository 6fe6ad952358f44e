"""MJX: one checkpointed scan with a small carry, and failure flags, on processors and GPUs."""

import dataclasses
import functools
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled, is_traced
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.contact.collision import first_missed, slot_geoms
from mjxgrad.engines.engine import Motion, Rows, one_each
from mjxgrad.engines.state import State, Trajectory, data_of, direction, is_sound, state_of
from mjxgrad.scene import Scene
from mjxgrad.scene.scene import numbers_of
from mjxgrad.stepping import pairs
from mjxgrad.stepping import Contact, Discrete, Onset, Slope, Smoothing, forward, step
from mjxgrad.stepping.onset import reach


class MJX:
    """MuJoCo's step in JAX; see `engines.engine.Engine`."""

    title: ClassVar[str] = "MJX"
    contacts: ClassVar[tuple[type, ...]] = (Discrete, Slope, Onset, Smoothing)
    compiles: ClassVar[bool] = True
    steers: ClassVar[bool] = False

    def complete(self, scene: Scene, state: State) -> State:
        return state

    def roll_out(self, motion: Motion, state: State, rows: Rows) -> Trajectory:
        # Functions may read changing variables: every call traces them anew, unless the caller compiles.
        has_functions = motion.policy is not None or motion.observe is not None
        is_part = has_functions or is_traced((motion, state, rows))
        return (_roll_out if is_part else _roll_out_compiled)(motion, state, rows)

    def hold(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact) -> State:
        def advance(now: State, _: None) -> tuple[State, None]:
            return state_of(step(scene.model, data_of(scene, now, ctrl), contact=contact)), None

        return jax.lax.scan(advance, dataclasses.replace(state, pairs=None), None, length=num_steps)[0]

    def linearise(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact
    ) -> tuple[Array, Array, Array, Array]:
        nv, size = scene.model.nv, 2 * scene.model.nv + scene.model.na
        end = step(scene.model, data_of(scene, state, ctrl), contact=contact)

        def moved(change: Float[Array, " both"]) -> tuple[Array, Array]:
            data = data_of(scene, state, ctrl + change[size:]).replace(
                qpos=integrate_position(scene.model, state.qpos, change[:nv], 1.0),
                qvel=state.qvel + change[nv : 2 * nv],
                act=state.act + change[2 * nv : size],
            )
            found = step(scene.model, data, contact=contact)
            change = position_change(scene.model, end.qpos, found.qpos)
            return jnp.concatenate([change, found.qvel, found.act]), found.sensordata

        of_state, of_sensors = jax.jacfwd(moved)(jnp.zeros(size + scene.model.nu, state.qvel.dtype))
        return of_state[:, :size], of_state[:, size:], of_sensors[:, :size], of_sensors[:, size:]


class _Carry(NamedTuple):
    """The carry of the scan: the last good state, what to count as in `Trajectory`, and the tangent that measures growth.

    `before` is the previous control, under which a policy observes; None for a policy that sees the state.
    """

    state: State
    flight: pairs.Flight | None
    before: Array | None
    first_bad: Array
    unsolved: Array
    crowded: Array
    tangent: tuple[Array, Array] | None
    growth: Array | None


class _Scan(Motion):
    """The loop over the steps of one rollout."""

    @property
    def follows(self) -> bool:
        return isinstance(self.contact, Slope) and pairs.NUM_SLOTS > 0 and not self.measure_growth

    def whole(self, carry: _Carry) -> State:
        state = carry.state
        if carry.flight is None:
            return state
        seen = pairs.whole(self.scene.model, pairs.Motion(state.qpos, state.qvel, state.act), carry.flight)
        return dataclasses.replace(state, **seen._asdict())

    def begin(self, state: State) -> _Carry:
        """Return the carry of the first step."""
        looks = self.policy is not None and self.policy_sees == "observations"
        # A NaN in the contacts of a traced model would go unnoticed.
        traced = [x for x in numbers_of(self.scene.model).values() if isinstance(x, jax.core.Tracer)]
        has_numbers = ~jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in traced])) if traced else jnp.array(True)
        return _Carry(
            dataclasses.replace(state, pairs=None),
            pairs.no_flight(self.scene.model, self.scene.data) if self.follows else None,
            self.scene.data.ctrl if looks else None,
            jnp.where(has_numbers, jnp.int32(-1), jnp.int32(0)),
            jnp.zeros((), jnp.int32),
            jnp.zeros((), jnp.int32),
            direction(state) if self.measure_growth else None,
            jnp.ones((), state.qvel.dtype) if self.measure_growth else None,
        )

    def advance(self, carry: _Carry, given: tuple[Array, Rows]) -> tuple[_Carry, tuple]:
        """Take one step, and return the next carry and the outputs of this step."""
        state, model = self.whole(carry), self.scene.model
        flight = carry.flight
        index, rows = given
        row, disturbance, forces = rows.controls, rows.noise, rows.inputs
        seen = None if carry.before is None else self.look(state, carry.before, forces)
        if self.policy is not None:
            row = one_each(self.policy(self.params, state if carry.before is None else seen), model.nu)
        ctrl = row + disturbance
        data = data_of(self.scene, carry.state, ctrl).replace(**forces)
        tangent, growth = carry.tangent, carry.growth
        if flight is not None:
            stepped, flight = pairs.follow(model, data, flight)
        elif tangent is None or growth is None:
            stepped = step(model, data, contact=self.contact)
        else:
            stepped, tangent, growth = self.measure(data, tangent, growth)
        moved = state_of(stepped)
        is_bad = ~is_sound(moved.qpos, moved.qvel, moved.act)
        first_bad = jnp.where((carry.first_bad < 0) & is_bad, index, carry.first_bad)
        following = _Carry(
            jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), carry.state, moved),
            flight,
            None if carry.before is None else ctrl.astype(carry.before.dtype),
            first_bad,
            carry.unsolved + ((first_bad < 0) & (stepped._impl.solver_niter > model.opt.iterations)),
            carry.crowded + ((first_bad < 0) & _is_crowded(model, jax.lax.stop_gradient(stepped), self.contact)),
            tangent,
            growth,
        )
        return following, (state.qpos, state.qvel, state.act, ctrl, self.look(state, ctrl, forces, None if flight is not None else stepped), seen)

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


def _roll_out(motion: Motion, state: State, rows: Rows) -> Trajectory:
    scan = _Scan(**{field.name: getattr(motion, field.name) for field in dataclasses.fields(motion)})
    advance = functools.partial(_Scan.advance, scan)  # a bound method of a pytree has no hash
    if scan.checkpoint:
        keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
        # Inside a scan prevent_cse is needless: XLA cannot merge the recomputation with the forward pass.
        advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
    first, steps = scan.begin(state), jnp.arange(len(rows.controls), dtype=jnp.int32)
    end, (qpos, qvel, act, ctrl, observed, seen) = jax.lax.scan(advance, first, (steps, rows))
    final, growth = scan.whole(end), end.growth
    if scan.observe is not None:
        last = scan.look(final, ctrl[-1], jax.tree.map(lambda x: x[-1], rows.inputs))
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


_roll_out_compiled = compiled(_roll_out)


def _is_crowded(model: mjx.Model, data: mjx.Data, contact: Contact) -> Bool[Array, ""]:
    """Return whether contacts may have acted without a slot in the step behind this data."""
    if not data._impl.ncon or slot_geoms(model, data) is not None:
        return jnp.array(False)
    if isinstance(contact, Smoothing):
        return jnp.array(True)
    return first_missed(model, data) < (reach(model, data, contact) if isinstance(contact, Onset) else 0.0)
