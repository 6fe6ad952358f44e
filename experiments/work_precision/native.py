"""C MuJoCo on the same starts, on some threads."""

import contextlib
import time
from collections.abc import Iterator

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from experiments.work_precision.cases import Case
from experiments.work_precision.outcome import NUM_ITERATIONS
from experiments.work_precision.programs import Cone, Ends, Integrator, Knobs, c_model, steps

# Rollouts keep every state on the way: this many at once stay within some hundred megabytes.
_AT_A_TIME = 128


def simulate(
    case: Case,
    qvel: Float[np.ndarray, "batch nv"],
    knobs: Knobs,
    *,
    integrator: Integrator = "Euler",
    cone: Cone = "pyramidal",
    iterations: int = NUM_ITERATIONS,
    threads: int = 1,
) -> tuple[Ends, float]:
    """Simulate a batch.

    Args:
        case: the scene.
        qvel: start velocities.
        knobs: time step and solver tolerance; softening is left aside.
        integrator: its name.
        cone: its name.
        iterations: of the solver, at most.
        threads: of the rollout.

    Returns:
        Final positions and velocities, and the wall time.
    """
    model = c_model(case, integrator, cone, iterations)
    model.opt.timestep, model.opt.tolerance = knobs.timestep, knobs.tolerance
    # What diverges shall end as no number, not at a new start.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    num_steps, batch = steps(case, knobs.timestep), len(qvel)
    initial = np.zeros((batch, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    initial[:, 1 : 1 + model.nq] = case.start[0]
    initial[:, 1 + model.nq : 1 + model.nq + model.nv] = qvel
    workers, seconds, finals = [mujoco.MjData(model) for _ in range(threads)], 0.0, []
    with _unsaid(), mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        for part in np.array_split(initial, -(-batch // _AT_A_TIME)):
            control = np.tile(case.controls, (len(part), num_steps, 1)) if model.nu else None
            begun = time.perf_counter()
            states, _ = pool.rollout([model] * len(part), workers, part, control, nstep=num_steps)
            seconds += time.perf_counter() - begun
            finals.append(np.asarray(states)[:, -1])
    final = np.concatenate(finals)
    return (final[:, 1 : 1 + model.nq], final[:, 1 + model.nq : 1 + model.nq + model.nv]), seconds


def has_own_implicit(case: Case) -> bool:
    """Say whether implicitfast does anything that Euler, with its implicit joint damping, does not.

    Args:
        case: the scene.

    Returns:
        False where both end in the same state but for rounding.
    """
    knobs = Knobs(case.model.opt.timestep, 1e-10)
    velocity = case.start[1][None]
    explicit, implicit = (simulate(case, velocity, knobs, integrator=name)[0][0] for name in ("Euler", "implicitfast"))
    return not np.allclose(explicit, implicit, rtol=0, atol=1e-7)


def differences(model: mujoco.MjModel, start: Ends, end: Ends) -> Float[np.ndarray, "batch nv"]:
    """Give position differences as `mj_differentiatePos` does, in m and rad, one per degree of freedom.

    Args:
        model: of C MuJoCo.
        start: states.
        end: states.

    Returns:
        What takes each start to its end; NaN where one is not finite.
    """
    found = np.full((len(end[0]), model.nv), np.nan)
    for row, (one, other) in enumerate(zip(start[0], end[0], strict=True)):
        if np.isfinite(one).all() and np.isfinite(other).all():
            mujoco.mj_differentiatePos(model, found[row], 1.0, one, other)
    return found


@contextlib.contextmanager
def _unsaid() -> Iterator[None]:
    """Keep C MuJoCo from writing a warning, to the terminal and to a file, for each state that diverges: the error says it."""
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)
