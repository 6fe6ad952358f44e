"""What simulates a batch: few compiled programs, for each takes long, and C MuJoCo beside them.

Time step, number of steps and solver tolerance are arguments, so that nothing is compiled for another one.
"""

import contextlib
import copy
import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.motion import advance
from experiments.parallel import num_cores
from experiments.work_precision.cases import CONES, Case
from experiments.work_precision.outcome import MJX, C, Integrator, Knobs, Variant
from experiments.work_precision.settings import Sizes
from mjxgrad._mjx import mjx
from mjxgrad.stepping import own_motion

Ends = tuple[Float[np.ndarray, "batch nq"], Float[np.ndarray, "batch nv"]]

_INTEGRATORS: dict[Integrator, mujoco.mjtIntegrator] = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
# C MuJoCo's rollouts keep every state on the way: this many at once stay within some hundred megabytes.
_AT_A_TIME = 128


@dataclass(frozen=True)
class Program:
    """A compiled simulation of one scene: the model, on the device in the variant's precision, and the executable.

    `compile_seconds` were taken to trace and compile it, or to load it if a former run has compiled it.
    """

    case: Case
    variant: Variant
    model: mjx.Model
    call: Callable[..., Any]
    compile_seconds: float

    def timed(self, qvel: Float[np.ndarray, "batch nv"], knobs: Knobs) -> tuple[Any, float]:
        """Give final positions and velocities, or outcomes and their slopes by the uncertain velocities; and the wall time."""
        begun = time.perf_counter()
        dtype = np.dtype(self.variant.precision)
        timestep, tolerance = (jnp.asarray(np.asarray(each, dtype)) for each in (knobs.timestep, knobs.tolerance))
        model = softened(self.model, knobs.softening)
        model = model.tree_replace({"opt.timestep": timestep, "opt.tolerance": tolerance})
        num_steps = np.int32(round(self.case.duration / knobs.timestep))
        found = jax.tree.map(np.asarray, self.call(model, np.asarray(qvel, dtype), num_steps))
        return found, time.perf_counter() - begun


@dataclass(frozen=True)
class Native:
    """C MuJoCo on the same starts, a batch on every core; the same two calls as a program's."""

    case: Case
    variant: Variant
    compile_seconds = 0.0

    def timed(self, qvel: Float[np.ndarray, "batch nv"], knobs: Knobs) -> tuple[Ends, float]:
        """Simulate from these velocities, softening left aside, and tell the wall time."""
        case, model = self.case, _c_model(self.case, self.variant)
        model.opt.timestep, model.opt.tolerance = knobs.timestep, knobs.tolerance
        # What diverges shall end as no number, not at a new start.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        num_steps, batch = round(case.duration / knobs.timestep), len(qvel)
        initial = np.zeros((batch, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        velocities = slice(1 + model.nq, 1 + model.nq + model.nv)
        initial[:, 1 : 1 + model.nq], initial[:, velocities] = case.start[0], qvel
        threads = num_cores() if batch > 1 else 1
        workers, seconds, finals = [mujoco.MjData(model) for _ in range(threads)], 0.0, []
        with _unsaid(), mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
            for part in np.array_split(initial, -(-batch // _AT_A_TIME)):
                control = np.tile(case.controls, (len(part), num_steps, 1)) if model.nu else None
                begun = time.perf_counter()
                states, _ = pool.rollout([model] * len(part), workers, part, control, nstep=num_steps)
                seconds += time.perf_counter() - begun
                finals.append(np.asarray(states)[:, -1])
        final = np.concatenate(finals)
        return (final[:, 1 : 1 + model.nq], final[:, velocities]), seconds


def repeated(
    program: Program | Native, qvel: Float[np.ndarray, "batch nv"], knobs: Knobs, sizes: Sizes
) -> tuple[Any, tuple[float, ...]]:
    """Simulate at least twice, and again while it takes little time; a short first time only warms up."""
    result, first = program.timed(qvel, knobs)
    taken = [first] if first > sizes.seconds else []
    while len(taken) < 2 or (len(taken) < sizes.repeats and sum(taken) < sizes.seconds):
        result, seconds = program.timed(qvel, knobs)
        taken.append(seconds)
    return result, tuple(taken)


def softened(model: mjx.Model, factor: float) -> mjx.Model:
    """Multiply the time constants of all contacts, the damping ratio kept; stiffness falls with the factor's square."""
    if factor == 1.0:
        return model

    def changed(solref: Array) -> Array:
        # Negative numbers are stiffness and damping themselves.
        direct = solref / jnp.asarray([factor**2, factor], solref.dtype)
        standard = solref * jnp.asarray([factor, 1.0], solref.dtype)
        return jnp.where(solref[..., :1] < 0, direct, standard)

    return model.replace(geom_solref=changed(model.geom_solref), pair_solref=changed(model.pair_solref))


def has_own_implicit(case: Case) -> bool:
    """Say whether implicitfast does anything that Euler, with its implicit joint damping, does not, but for rounding."""
    knobs, velocity = Knobs(case.timestep, 1e-10), case.start[1][None]
    explicit, implicit = (
        Native(case, Variant(C, integrator)).timed(velocity, knobs)[0][0] for integrator in ("Euler", "implicitfast")
    )
    return not np.allclose(explicit, implicit, rtol=0, atol=1e-7)


def _c_model(case: Case, variant: Variant) -> mujoco.MjModel:
    model = copy.deepcopy(case.model)
    model.opt.integrator, model.opt.cone = _INTEGRATORS[variant.integrator], CONES[variant.cone]
    model.opt.solver, model.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, variant.iterations
    return model


@contextlib.contextmanager
def _unsaid() -> Iterator[None]:
    """Keep C MuJoCo from writing a warning, to the terminal and to a file, for each state that diverges: the error says it."""
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def compiled(case: Case, variant: Variant) -> Program:
    """Trace and compile a scene's program."""
    begun, dtype = time.perf_counter(), np.dtype(variant.precision)
    with jax.enable_x64(variant.precision == "float64"):
        scene = mg.load_scene(_c_model(case, variant))
        start = scene.data.replace(
            qpos=jnp.asarray(case.start[0], dtype), ctrl=jnp.asarray(case.controls, dtype), time=jnp.zeros((), dtype)
        )
        simulate = functools.partial(_simulate, variant, start)
        if variant.derivative is not None:
            simulate = functools.partial(_differentiate, simulate, case)
        batched = jax.jit(jax.vmap(simulate, in_axes=(None, 0, None)))
        call = batched.lower(scene.model, np.zeros((variant.batch, case.model.nv), dtype), np.int32(1)).compile()
    return Program(case, variant, scene.model, call, time.perf_counter() - begun)


def _simulate(
    variant: Variant, start: mjx.Data, model: mjx.Model, qvel: Float[Array, " nv"], num_steps: Array
) -> tuple[Array, Array]:
    contact = mg.Onset() if variant.onset else own_motion(variant.derivative or "discrete")

    def step(data: mjx.Data) -> mjx.Data:
        if variant.library == MJX:
            return mjx.step(model, data)
        return mg.step(model, data, contact=contact)

    final = advance(step, start.replace(qvel=qvel), num_steps)
    return final.qpos, final.qvel


def _differentiate(
    simulate: Callable, case: Case, model: mjx.Model, qvel: Float[Array, " nv"], num_steps: Array
) -> tuple[Array, Array]:
    """Forward mode, which the library takes for so few parameters too, and which a loop of any length has."""
    weights = jnp.asarray(case.weights, qvel.dtype)

    def along(direction: Array) -> tuple[Array, Array]:
        return jax.jvp(lambda at: weights @ simulate(model, at, num_steps)[0], (qvel,), (direction,))

    return jax.vmap(along, out_axes=(None, 0))(jnp.asarray(case.directions, qvel.dtype))
