"""MJX: one checkpointed scan with a small carry, and failure flags, on processors and GPUs."""

import dataclasses
import functools
import warnings
import weakref
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from mjxgrad._mjx import mjx
from mjxgrad._programs import compiled, is_traced
from mjxgrad.batched.cholesky import SOLUTION
from mjxgrad.bodies.kinematics import integrate_position, position_change
from mjxgrad.contact.collision import first_missed, slot_geoms
from mjxgrad.engines.engine import Inputs, Motion, Observe, Rows, one_each
from mjxgrad.engines.layout import INPUTS
from mjxgrad.engines.pool import pool_of
from mjxgrad.engines.state import State, Trajectory, data_of, is_sound, state_of
from mjxgrad.scene import Scene, SceneWarning
from mjxgrad.scene.scene import changed_numbers, numbers_of
from mjxgrad.stepping import Contact, Discrete, Onset, OwnMotion, Slope, Smoothing, forward, pairs, step
from mjxgrad.stepping.onset import reach

_NUM_STEPS = 8
_APART = 0.05  # of the largest change of a speed in a step; solvers of few iterations are off by some thousandths
_SMALLEST = 1e-3  # of such a change (m/s or rad/s)
_SEEN: weakref.WeakSet[mujoco.MjModel] = weakref.WeakSet()


class MJX:
    """MuJoCo's step in JAX; see `engines.engine.Engine`."""

    title: ClassVar[str] = "MJX"
    contacts: ClassVar[tuple[type, ...]] = (Discrete, Slope, Onset, Smoothing)
    compiles: ClassVar[bool] = True
    steers: ClassVar[bool] = False

    def complete(self, scene: Scene, state: State, contact: Contact) -> State:
        is_followed = isinstance(contact, Slope) and not isinstance(state.pairs, pairs.Flight)
        return dataclasses.replace(state, pairs=pairs.no_flight(scene.model, scene.data)) if is_followed else state

    def roll_out(self, motion: Motion, state: State, rows: Rows) -> Trajectory:
        # Functions may read changing variables: every call traces them anew, unless the caller compiles.
        has_functions = motion.policy is not None or motion.observe is not None
        is_known = not is_traced((motion, state, rows))
        found = (_roll_out_compiled if is_known and not has_functions else roll_out)(motion, state, rows)
        is_own = isinstance(motion.contact, OwnMotion) and is_known and not is_traced(found)
        if is_own and (message := _parting(motion.scene, found, rows.inputs)):
            warnings.warn(f"{motion.scene.name}: {message}", SceneWarning, stacklevel=3)
        return found

    def hold(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], num_steps: int, contact: Contact) -> State:
        def advance(now: Moving, _: None) -> tuple[Moving, None]:
            return now.stepped(scene.model, data_of(scene, now.state, ctrl), contact)[1], None

        first = Moving.at(scene, state, contact)
        return jax.lax.scan(advance, first, None, length=num_steps)[0].end(scene.model, state)

    def look(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], inputs: Inputs, observe: Observe, contact: Contact
    ) -> PyTree:
        return observe(
            scene.model, forward(scene.model, data_of(scene, state, ctrl).replace(**inputs), contact=contact)
        )

    def after(self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact) -> Any:
        """Return the motion one step later, and the readings of sensors."""
        return step(scene.model, data_of(scene, state, ctrl), contact=contact)

    def linearise(
        self, scene: Scene, state: State, ctrl: Float[Array, " nu"], contact: Contact
    ) -> tuple[Array, Array, Array, Array]:
        nv, size = scene.model.nv, 2 * scene.model.nv + scene.model.na
        end = self.after(scene, state, ctrl, contact)

        def moved(change: Float[Array, " both"]) -> tuple[Array, Array]:
            start = dataclasses.replace(
                state,
                qpos=integrate_position(scene.model, state.qpos, change[:nv], 1.0),
                qvel=state.qvel + change[nv : 2 * nv],
                act=state.act + change[2 * nv : size],
            )
            found = self.after(scene, start, ctrl + change[size:], contact)
            change = position_change(scene.model, end.qpos, found.qpos)
            return jnp.concatenate([change, found.qvel, found.act]), found.sensordata

        of_state, of_sensors = jax.jacfwd(moved)(jnp.zeros(size + scene.model.nu, state.qvel.dtype))
        return of_state[:, :size], of_state[:, size:], of_sensors[:, :size], of_sensors[:, size:]


class Moving(eqx.Module):
    """A state, and what is in flight beside it where a slope is asked for; see `stepping.pairs`."""

    state: State
    flight: pairs.Flight | None

    @staticmethod
    def at(scene: Scene, state: State, contact: Contact) -> "Moving":
        """Return a state that may have pairs in flight; its derivative is then that of all."""
        alone = dataclasses.replace(state, pairs=None)
        if not isinstance(contact, Slope):
            return Moving(alone, None)
        if not isinstance(state.pairs, pairs.Flight):
            return Moving(alone, pairs.no_flight(scene.model, scene.data))
        own = pairs.without(scene.model, pairs.Motion(state.qpos, state.qvel, state.act), state.pairs)
        return Moving(dataclasses.replace(alone, **own._asdict()), state.pairs)

    def seen(self, model: mjx.Model) -> State:
        """Return the state with its whole derivative."""
        if self.flight is None:
            return self.state
        own = pairs.Motion(self.state.qpos, self.state.qvel, self.state.act)
        return dataclasses.replace(self.state, **pairs.whole(model, own, self.flight)._asdict())

    def end(self, model: mjx.Model, given: State) -> State:
        """Return the state with its whole derivative, and pairs in flight where the given one has some."""
        is_kept = isinstance(given.pairs, pairs.Flight)
        kept = given.pairs if is_kept and self.flight is None else self.flight
        return dataclasses.replace(self.seen(model), pairs=kept if is_kept else None)

    def stepped(self, model: mjx.Model, data: mjx.Data, contact: Contact) -> tuple[mjx.Data, "Moving"]:
        """Return the data after a step from data of this state, and the next of these."""
        if self.flight is None:
            data, flight = step(model, data, contact=contact), None
        else:
            data, flight = pairs.follow(pairs.Program(model, data), self.flight)
        return data, Moving(state_of(data), flight)


class _Carry(NamedTuple):
    """The carry of the scan: the last good state, and what to count as in `Trajectory`."""

    moving: Moving
    before: Array | None  # the previous control, under which a policy observes; None for a policy that sees the state
    first_bad: Array
    unsolved: Array
    crowded: Array


class Scan(Motion):
    """The loop over the steps of one rollout."""

    def begin(self, state: State) -> _Carry:
        """Return the carry of the first step."""
        looks = self.policy is not None and self.policy_sees == "observations"
        # A NaN in the contacts of a traced model would go unnoticed.
        traced = [x for x in numbers_of(self.scene.model).values() if isinstance(x, jax.core.Tracer)]
        has_numbers = ~jnp.any(jnp.stack([jnp.any(jnp.isnan(x)) for x in traced])) if traced else jnp.array(True)
        first_bad, none = jnp.where(has_numbers, jnp.int32(-1), jnp.int32(0)), jnp.zeros((), jnp.int32)
        moving = Moving.at(self.scene, state, self.contact)
        return _Carry(moving, self.scene.data.ctrl if looks else None, first_bad, none, none)

    def advance(self, carry: _Carry, given: tuple[Array, Rows]) -> tuple[_Carry, tuple]:
        """Take one step, and return the next carry and the outputs of this step."""
        model = self.scene.model
        state = carry.moving.seen(model)
        index, rows = given
        row, disturbance, forces = rows.controls, rows.noise, rows.inputs
        seen = None if carry.before is None else self.look(state, carry.before, forces)
        if self.policy is not None:
            row = one_each(self.policy(self.params, state if carry.before is None else seen), model.nu)
        ctrl = row + disturbance
        data = data_of(self.scene, carry.moving.state, ctrl).replace(**forces)
        stepped, moving = self.step(carry.moving, data)
        is_unsolved, is_crowded = self.troubles(stepped)
        is_bad = ~is_sound(*(getattr(moving.state, name) for name in ("qpos", "qvel", "act")))
        first_bad = jnp.where((carry.first_bad < 0) & is_bad, index, carry.first_bad)
        following = _Carry(
            jax.tree.map(lambda old, new: jnp.where(first_bad >= 0, old, new), carry.moving, moving),
            None if carry.before is None else ctrl.astype(carry.before.dtype),
            first_bad,
            carry.unsolved + ((first_bad < 0) & is_unsolved),
            carry.crowded + ((first_bad < 0) & is_crowded),
        )
        # A step's data has the derivative along the motion alone.
        observed = self.look(state, ctrl, forces, None if moving.flight is not None else stepped)
        return following, (state.qpos, state.qvel, state.act, ctrl, observed, seen)

    def step(self, moving: Moving, data: mjx.Data) -> tuple[Any, Moving]:
        return moving.stepped(self.scene.model, data, self.contact)

    def troubles(self, stepped: Any) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Return whether a step was not solved to the end, and whether contacts lacked room."""
        model, data = self.scene.model, jax.lax.stop_gradient(stepped)
        if not data._impl.ncon or slot_geoms(model, data) is not None:
            crowded = jnp.array(False)
        elif isinstance(self.contact, Smoothing):
            crowded = jnp.array(True)
        else:
            away = reach(model, data, self.contact) if isinstance(self.contact, Onset) else 0.0
            crowded = first_missed(model, data) < away
        return stepped._impl.solver_niter > model.opt.iterations, crowded

    def look(self, state: State, ctrl: Array, forces: dict, stepped: Any = None) -> PyTree:
        """Return the observations in a state under a control, from the data of a step where it is given."""
        if self.observe is None:
            return None
        model = self.scene.model
        has_stages = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        if stepped is None or has_stages:  # data of a multi-stage step belongs to its last stage
            return MJX().look(self.scene, state, ctrl, forces, self.observe, self.contact)
        data = data_of(self.scene, state, ctrl)
        at_start = {name: getattr(data, name) for name in ("qpos", "qvel", "act", "time")}
        return self.observe(model, stepped.replace(**at_start))


def roll_out(motion: Motion, state: State, rows: Rows, loop: type[Scan] = Scan) -> Trajectory:
    """Return the result of `rollout` by a loop."""
    scan = loop(**{field.name: getattr(motion, field.name) for field in dataclasses.fields(motion)})
    advance = functools.partial(loop.advance, scan)  # a bound method of a pytree has no hash
    if scan.checkpoint:
        keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
        # Inside a scan prevent_cse is needless: XLA cannot merge the recomputation with the forward pass.
        advance = jax.checkpoint(advance, policy=keep, prevent_cse=False)
    first, steps = scan.begin(state), jnp.arange(len(rows.controls), dtype=jnp.int32)
    end, (qpos, qvel, act, ctrl, observed, seen) = jax.lax.scan(advance, first, (steps, rows))
    final = end.moving.end(scan.scene.model, state)
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
        act=jnp.concatenate([act, final.act[None]]),
        seen=seen,
    )


_roll_out_compiled = compiled(roll_out)


def _parting(scene: Scene, found: Trajectory, inputs: dict[str, Array]) -> str | None:
    """Say where steps of a known rollout by MJX are not C MuJoCo's; None where they are, or were looked at before."""
    # To compile a step for the sake of a comparison takes up to a minute. The first rollout has some already.
    last = len(found.ctrl) if found.first_bad_step < 0 else int(found.first_bad_step)
    if scene.mj_model in _SEEN or not last:
        return None
    _SEEN.add(scene.mj_model)
    steps = np.unique(np.linspace(0, last - 1, _NUM_STEPS).astype(int))
    starts = {name: np.asarray(getattr(found, name))[steps] for name in ("qpos", "qvel", "act")}
    given = {name: np.asarray(getattr(scene.data, name)) for name in INPUTS[1:]}
    given = {name: np.broadcast_to(value, (len(steps), *value.shape)) for name, value in given.items()}
    given |= {name: np.asarray(value)[steps] for name, value in inputs.items()}
    given = {name: value[:, None] for name, value in given.items() if value.size}
    given["ctrl"] = np.asarray(found.ctrl)[steps][:, None]
    numbers = {name: np.asarray(value)[None] for name, value in changed_numbers(scene).items()}
    after = pool_of(scene.mj_model).run(numbers, {"time": np.zeros((len(steps), 1)), **starts}, given)["qvel"][:, 0]
    ours = np.asarray(found.qvel)[steps + 1]
    off = np.abs(ours - after) / np.maximum(np.abs(after - starts["qvel"]).max(axis=1, keepdims=True), _SMALLEST)
    place, dof = np.unravel_index(off.argmax(), off.shape)
    if not off[place, dof] > _APART:
        return None
    joint = scene.mj_model.dof_jntid[dof]
    name = scene.mj_model.joint(joint).name or f"joint {joint}"
    single = " or take double precision, if rounding decides what touches" if ours.dtype == np.float32 else ""
    return (
        f"step {steps[place]} by MJX is not C MuJoCo's: {name} has a speed of {ours[place, dof]:.4g} after it, by C MuJoCo "
        f"{after[place, dof]:.4g}; load it with engine='mujoco'{single}"
    )
