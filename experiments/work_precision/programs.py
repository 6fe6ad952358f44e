"""Programs that simulate a batch: few, for what compiles is each scene with each integrator, cone, precision and library.

Time step, number of steps and solver tolerance are arguments. A program is traced in the main thread, where the precision is
set, and compiled in another, several at a time.
"""

import contextlib
import copy
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.parallel import num_compilers
from experiments.work_precision.cases import Case
from experiments.work_precision.outcome import NUM_ITERATIONS
from mjxgrad._mjx import mjx

Library = Literal["mg", "mjx"]
Integrator = Literal["Euler", "implicitfast", "RK4"]
Cone = Literal["pyramidal", "elliptic"]
Precision = Literal["float32", "float64"]
Ends = tuple[Float[np.ndarray, "batch nq"], Float[np.ndarray, "batch nv"]]

INTEGRATORS: dict[Integrator, mujoco.mjtIntegrator] = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}
CONES: dict[Cone, mujoco.mjtCone] = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
}
_STATE = ("qpos", "qvel", "act", "time", "qacc_warmstart")
# And too few, to see what they cost in error.
FEW_ITERATIONS = (1, 3)


@dataclass(frozen=True)
class Variant:
    """What a program is compiled for, beside the scene.

    Attributes:
        library: whose step.
        integrator: of the step.
        cone: of friction.
        precision: of every array.
        batch: starts simulated together.
        derivative: along the uncertain velocities; None for the motion alone.
        onset: whether contacts begin within the step.
        iterations: of the solver, at most.
    """

    library: Library
    integrator: Integrator = "Euler"
    cone: Cone = "pyramidal"
    precision: Precision = "float64"
    batch: int = 1
    derivative: Literal["discrete", "event"] | None = None
    onset: bool = False
    iterations: int = NUM_ITERATIONS


@dataclass(frozen=True)
class Knobs:
    """What a program is told at each call.

    Attributes:
        timestep: in s.
        tolerance: of the solver.
        softening: factor on the time constants of contacts.
    """

    timestep: float
    tolerance: float
    softening: float = 1.0


@dataclass(frozen=True)
class Program:
    """A compiled simulation of one scene.

    Attributes:
        case: the scene.
        variant: what it was compiled for.
        model: on the device, in the variant's precision.
        call: the executable.
        trace_seconds: taken to trace it.
        compile_seconds: taken to compile it, or to load it if a former run has compiled it.
    """

    case: Case
    variant: Variant
    model: mjx.Model
    call: Callable[..., Any]
    trace_seconds: float
    compile_seconds: float

    def run(self, qvel: Float[np.ndarray, "batch nv"], knobs: Knobs) -> Any:
        """Simulate from these velocities.

        Args:
            qvel: in place of the start's.
            knobs: of this call.

        Returns:
            Final positions and velocities; with a derivative, outcomes and their slopes along the uncertain velocities.
        """
        dtype = np.dtype(self.variant.precision)
        model = softened(self.model, knobs.softening).tree_replace(
            {
                "opt.timestep": jnp.asarray(np.asarray(knobs.timestep, dtype)),
                "opt.tolerance": jnp.asarray(np.asarray(knobs.tolerance, dtype)),
            }
        )
        num_steps = np.int32(steps(self.case, knobs.timestep))
        return jax.tree.map(np.asarray, self.call(model, np.asarray(qvel, dtype), num_steps))


def steps(case: Case, timestep: float) -> int:
    """Give the number of steps of a motion."""
    return round(case.duration / timestep)


def compiled(case: Case, variants: Sequence[Variant], on_each: Callable[[], None]) -> dict[Variant, Program]:
    """Compile the programs of a scene.

    Args:
        case: the scene.
        variants: what to compile it for.
        on_each: called as each is done, in their order.

    Returns:
        By variant.
    """
    waiting: dict[Variant, tuple[mjx.Model, float, Future]] = {}
    with ThreadPoolExecutor(num_compilers()) as pool:
        for variant in variants:
            begun = time.perf_counter()
            model, lowered = _lowered(case, variant)
            waiting[variant] = model, time.perf_counter() - begun, pool.submit(_compile, lowered)
        programs = {}
        for variant, (model, traced, result) in waiting.items():
            call, seconds = result.result()
            programs[variant] = Program(case, variant, model, call, traced, seconds)
            on_each()
    return programs


def softened(model: mjx.Model, factor: float) -> mjx.Model:
    """Multiply the time constants of all contacts, the damping ratio kept.

    Args:
        model: of MJX.
        factor: on the time constants; stiffness falls with its square.

    Returns:
        A model with softer contacts.
    """
    if factor == 1.0:
        return model

    def changed(solref: Array) -> Array:
        # Negative numbers are stiffness and damping themselves.
        direct = solref / jnp.asarray([factor**2, factor], solref.dtype)
        standard = solref * jnp.asarray([factor, 1.0], solref.dtype)
        return jnp.where(solref[..., :1] < 0, direct, standard)

    return model.replace(geom_solref=changed(model.geom_solref), pair_solref=changed(model.pair_solref))


def c_model(case: Case, integrator: Integrator, cone: Cone, iterations: int = NUM_ITERATIONS) -> mujoco.MjModel:
    """Give the C model of a scene with another integrator and cone, its solver run to convergence unless told otherwise.

    Args:
        case: the scene.
        integrator: its name.
        cone: its name.
        iterations: of the solver, at most.

    Returns:
        A copy.
    """
    model = copy.deepcopy(case.model)
    model.opt.integrator, model.opt.cone = INTEGRATORS[integrator], CONES[cone]
    model.opt.solver, model.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, iterations
    return model


def timed(function: Callable[[], Any], *, repeats: int, seconds: float) -> tuple[Any, tuple[float, ...]]:
    """Call what is compiled, at least twice.

    Args:
        function: blocks until it is done.
        repeats: at most.
        seconds: after which, twice done, it is not called again. A first call shorter than this only warms up.

    Returns:
        What it returned last, and the wall time of each call that counts.
    """
    begun = time.perf_counter()
    result = function()
    first = time.perf_counter() - begun
    taken = [first] if first > seconds else []
    while len(taken) < 2 or (len(taken) < repeats and sum(taken) < seconds):
        begun = time.perf_counter()
        result = function()
        taken.append(time.perf_counter() - begun)
    return result, tuple(taken)


def own_cone(case: Case) -> Cone:
    """Give the name of the cone in the scene's file."""
    return next(name for name, cone in CONES.items() if cone == case.model.opt.cone)


def _compile(lowered: jax.stages.Lowered) -> tuple[Callable[..., Any], float]:
    begun = time.perf_counter()
    executable = lowered.compile()
    return executable, time.perf_counter() - begun


def _lowered(case: Case, variant: Variant) -> tuple[mjx.Model, jax.stages.Lowered]:
    with _in_precision(variant.precision):
        scene = mg.load_scene(c_model(case, variant.integrator, variant.cone, variant.iterations))
        dtype = np.dtype(variant.precision)
        template = scene.data.replace(
            qpos=jnp.asarray(case.start[0], dtype), ctrl=jnp.asarray(case.controls, dtype), time=jnp.zeros((), dtype)
        )
        simulate = functools.partial(_simulate, _step(variant), template)
        if variant.derivative is not None:
            simulate = functools.partial(_differentiate, simulate, case)
        batched = jax.vmap(simulate, in_axes=(None, 0, None))
        qvel = np.zeros((variant.batch, case.model.nv), dtype)
        return scene.model, jax.jit(batched).lower(scene.model, qvel, np.int32(1))


def _step(variant: Variant) -> Callable[[mjx.Model, mjx.Data], mjx.Data]:
    if variant.library == "mjx":
        return mjx.step
    onset = mg.Onset() if variant.onset else None
    return functools.partial(mg.step, gradient=variant.derivative or "discrete", onset=onset)


def _simulate(
    step: Callable[[mjx.Model, mjx.Data], mjx.Data],
    template: mjx.Data,
    model: mjx.Model,
    qvel: Float[Array, " nv"],
    num_steps: Array,
) -> tuple[Array, Array]:
    def advance(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        moved = step(model, template.replace(**dict(zip(_STATE, state, strict=True))))
        return tuple(getattr(moved, name) for name in _STATE)

    start = tuple(getattr(template.replace(qvel=qvel), name) for name in _STATE)
    final = jax.lax.fori_loop(0, num_steps, advance, start)
    return final[0], final[1]


def _differentiate(
    simulate: Callable, case: Case, model: mjx.Model, qvel: Float[Array, " nv"], num_steps: Array
) -> tuple[Array, Array]:
    """Forward mode, which the library takes for so few parameters too, and which a loop of any length has."""
    weights = jnp.asarray(case.weights, qvel.dtype)

    def outcome(velocity: Array) -> Array:
        return weights @ simulate(model, velocity, num_steps)[0]

    def along(direction: Array) -> tuple[Array, Array]:
        return jax.jvp(outcome, (qvel,), (direction,))

    return jax.vmap(along, out_axes=(None, 0))(jnp.asarray(case.directions, qvel.dtype))


@contextlib.contextmanager
def _in_precision(precision: Precision) -> Iterator[None]:
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", precision == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)
