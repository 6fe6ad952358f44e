"""From settings to numbers: derivatives of the throw, their error and their time."""

import functools
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import mjxgrad as mg
from experiments.cube_toss.outcome import Course, Outcome, Point
from experiments.cube_toss.settings import Settings
from experiments.cube_toss.throw import DURATION, PUBLISHED_SPEED, CubeToss, cube_toss
from experiments.failure import ExperimentError
from experiments.workspace import Workspace
from mjxgrad._mjx import mjx
from mjxgrad._rollout import data_of
from mjxgrad.dynamics import Gradient, assembly
from mjxgrad.dynamics.events import contacts_of
from mjxgrad.integration import adaptive_rollout

# Half the step of the reference's difference quotient (m/s), and its tolerance.
_STEP, _TOLERANCE = 1e-4, 1e-10
_REPEATS = 1

Program = Callable[..., Float[Array, " throws"]]
_STATE = ("qpos", "qvel", "time", "qacc_warmstart")


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Take the derivative of every throw by every method.

    Raises:
        ExperimentError: if a time step does not divide the throw, or the reference fails.
    """
    for timestep in (*settings.timesteps, *settings.refined_timesteps):
        if abs(DURATION / timestep - round(DURATION / timestep)) > 1e-6:
            raise ExperimentError(f"timesteps must divide {DURATION:g} s, got {timestep:g}")
    speeds = PUBLISHED_SPEED + settings.interval * (jnp.arange(settings.num_throws) / settings.num_throws - 0.5)
    jobs = _jobs(settings)
    courses = []
    with workspace.stage("derivatives", "points", len(settings.contacts) * (1 + len(jobs))) as advance_to:
        programs = _programs(settings)
        for contact in settings.contacts:
            task = cube_toss(contact)
            workspace.check(task.scene)
            reference, _, failed = programs["reference"](task, speeds, jnp.asarray(_TOLERANCE))
            if bool(np.any(failed)):
                raise ExperimentError(f"the reference with {contact} contact needs more steps than it may take")
            points = []
            for name, setting in jobs:
                points.append(_point(programs, name, task, setting, speeds, np.asarray(reference)))
                advance_to(len(courses) * (1 + len(jobs)) + 1 + len(points))
            courses.append(Course(contact, np.asarray(speeds), np.asarray(reference), tuple(points)))
    return Outcome(settings, tuple(courses))


def _jobs(settings: Settings) -> list[tuple[str, float]]:
    fixed = [(name, h) for name in ("discrete", "event", "continuous") for h in settings.timesteps]
    refined = [("substeps", h) for h in settings.refined_timesteps]
    adaptive = [(name, tol) for name in ("adaptive", "quotient") for tol in settings.tolerances]
    return fixed + refined + adaptive


def _point(
    programs: dict[str, Program], name: str, task: CubeToss, setting: float, speeds: Array, reference: np.ndarray
) -> Point:
    def call():
        return jax.block_until_ready(programs[name](task, speeds, jnp.asarray(setting)))

    started = time.perf_counter()
    derivative, num_steps, failed = call()
    first = time.perf_counter() - started
    # Processor time: what else runs on the machine does not count.
    spent = []
    for _ in range(_REPEATS):
        begun = time.process_time()
        call()
        spent.append(time.process_time() - begun)
    return Point(
        method=name,
        setting=setting,
        derivative=np.asarray(derivative),
        error=np.asarray(derivative) - reference,
        seconds=float(np.median(spent)) / len(speeds),
        first_seconds=first,
        num_steps=float(np.mean(num_steps)),
        has_failed=bool(np.any(failed)),
    )


def _programs(settings: Settings) -> dict[str, Program]:
    """One program per method, whatever the contact and the time step; each takes the throws one after the other."""

    def fixed(gradient: str, onset: mg.Onset | None = None):
        def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
            return mg.step(model, data, gradient=gradient, onset=onset)  # pyright: ignore[reportArgumentType]

        return _marching(step)

    def short(model: mjx.Model, data: mjx.Data) -> mjx.Data:
        return substepped_step(model, data, num_substeps=settings.num_substeps, gradient="event")

    return {
        "discrete": fixed("discrete"),
        "event": fixed("event"),
        "continuous": fixed("discrete", mg.Onset()),
        "substeps": _marching(short),
        "adaptive": _one_by_one(_adaptive_derivative),
        "quotient": _one_by_one(_adaptive_quotient),
        "reference": _one_by_one(_adaptive_quotient),
    }


def _one_by_one(derivative: Callable) -> Program:
    @eqx.filter_jit
    def program(task: CubeToss, speeds: Array, setting: Array):
        return jax.lax.map(lambda speed: derivative(task, speed, setting), speeds)

    return program


def _marching(step: Callable[[mjx.Model, mjx.Data], mjx.Data]) -> Program:
    """Forward mode through steps whose length and number are traced."""

    def derivative(task: CubeToss, speed: Array, timestep: Array):
        end = functools.partial(_end, task, timestep=timestep, step=step)
        return jax.jvp(end, (speed,), (jnp.ones_like(speed),))[1], DURATION / timestep, jnp.zeros((), bool)

    return _one_by_one(derivative)


def _end(task: CubeToss, speed: Array, timestep: Array, step: Callable) -> Array:
    scene = task.scene
    start = data_of(scene, task.start(speed), scene.data.ctrl)
    count = jnp.round(DURATION / timestep).astype(int)
    model = scene.model.tree_replace({"opt.timestep": timestep})

    def advance(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        moved = step(model, start.replace(**dict(zip(_STATE, state, strict=True))))
        return tuple(getattr(moved, name) for name in _STATE)

    final = jax.lax.fori_loop(0, count, advance, tuple(getattr(start, name) for name in _STATE))
    return task.outcome(final[0])


def _adaptive_end(task: CubeToss, speed: Array, tolerance: Array):
    found = adaptive_rollout(task.scene, task.start(speed), jnp.array([DURATION]), tolerance=tolerance, max_steps=2**16)
    return task.outcome(found.qpos[-1]), (found.num_steps, found.has_failed)


def _adaptive_derivative(task: CubeToss, speed: Array, tolerance: Array):
    derivative, (num_steps, failed) = jax.grad(_adaptive_end, argnums=1, has_aux=True)(task, speed, tolerance)
    return derivative, num_steps.astype(float), failed


def _adaptive_quotient(task: CubeToss, speed: Array, tolerance: Array):
    ends, (num_steps, failed) = jax.lax.map(
        lambda at: _adaptive_end(task, at, tolerance), jnp.stack([speed - _STEP, speed + _STEP])
    )
    return (ends[1] - ends[0]) / (2 * _STEP), jnp.sum(num_steps).astype(float), jnp.any(failed)


def substepped_step(
    model: mjx.Model, data: mjx.Data, *, num_substeps: int, gradient: Gradient = "discrete"
) -> mjx.Data:
    """Advance by one time step, in short steps if a contact or limit begins or ends in it.

    A step holds an event if a distance changes its sign, judged by the distances at its beginning and the velocities at its
    end. Under `jax.vmap` every member takes the short steps in every step and throws them away.

    Args:
        model: as for `step`.
        data: the present state.
        num_substeps: short steps in a step that holds an event.
        gradient: as for `step`.

    Returns:
        Data whose state is one time step later. Its other fields are those of the last step taken, long or short.
    """
    after = mg.step(model, data, gradient=gradient)
    short = model.tree_replace({"opt.timestep": model.opt.timestep / num_substeps})

    def refine(data: mjx.Data) -> mjx.Data:
        def substep(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            return mg.step(short, data, gradient=gradient), None  # pyright: ignore[reportArgumentType]

        return jax.lax.scan(substep, data, length=num_substeps)[0]

    return jax.lax.cond(_holds_event(model, data, after), refine, lambda _: after, data)


def _holds_event(model: mjx.Model, before: mjx.Data, after: mjx.Data) -> Bool[Array, ""]:
    """Whether some distance changes its sign in a step."""
    # Contacts and kinematics of a stepped data are those of the state before; its position is not.
    blocks = assembly.gather(model, after.replace(qpos=before.qpos))
    if not any(block.rows_each for block in blocks):
        return jnp.zeros((), bool)
    distance, normal = contacts_of(blocks)
    later = distance + model.opt.timestep * normal @ after.qvel
    return jnp.any((distance < 0) != (later < 0))
