"""The tasks, with and without contact that begins within the step, and the points at which both are compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

import mjxgrad as mg
from experiments.policy_gradient.outcome import ONSET
from experiments.policy_gradient.settings import Settings

# What MuJoCo gives a contact that says nothing: solref 0.02 1 and solimp 0.9 0.95 0.001.
DEFAULT_CONTACT = mg.Softness(stiffness=2500.0, damping_ratio=1.0, impedance=(0.9, 0.95), width=0.001)
WALL_STIFFNESS = 1e4  # 1/s², that of the README
THROW_START, THROW_STDDEV, THROW_RATE = 0.5, 0.1, 0.02  # rad, rad, of Adam; the README's
HOPPER_RATE = 0.01
_JUMPS = (0.62, 1.29)  # rad: throws between about 35 and 74 degrees clear the wall


@dataclass(frozen=True)
class Descent:
    """How a task is optimised by Adam, by each of some estimators: "first" order or "alpha"-order."""

    start: Float[Array, " dim"]
    stddev: float
    learning_rate: float
    num_steps: int
    estimators: Sequence[str]


@dataclass(frozen=True)
class Point:
    """Parameters at which gradients are compared, and whether the noise covers a jump of the cost there."""

    label: str
    params: Float[Array, " dim"]
    hits_and_misses: bool = False


@dataclass(frozen=True)
class Problem:
    """A task with its name in the settings and its title."""

    name: str
    title: str
    task: Any
    stddev: float  # of the noise at the points where gradients are compared
    points: Sequence[Point]
    num_samples: int  # rollouts of one estimate
    has_jump_of_force: bool  # whether its contacts set in with a force that is not zero
    descent: Descent | None = None  # None if it is not optimised

    def objective(self, gradient: str, stddev: float) -> mg.Objective:
        """Give the task's cost with contact that begins within the step, or with MuJoCo's motion and its derivative."""
        return self.task.with_onset(mg.Onset() if gradient == ONSET else None).objective(jnp.asarray(stddev))


def problem(name: str, settings: Settings) -> Problem:
    """Build one of the tasks that the settings name."""
    if name.startswith("push"):
        stiffness = {"push_soft": 10.0, "push_stiff": 1000.0}[name]
        task = mg.tasks.push(stiffness)
        start = Point("start", task.initial_params())
        return Problem(name, f"Push, {stiffness:g} N/m", task, task.stddev, [start], 16, has_jump_of_force=False)
    return _hopper(settings) if name == "hopper" else _throw(name, settings)


def _throw(name: str, settings: Settings) -> Problem:
    is_default = name == "ball_wall_default"
    softness = DEFAULT_CONTACT if is_default else mg.tasks.wall_softness(WALL_STIFFNESS)
    points = [
        Point(
            f"{angle:g} rad", jnp.array([angle]), any(abs(angle - jump) < 3 * settings.angle_stddev for jump in _JUMPS)
        )
        for angle in settings.angles
    ]
    return Problem(
        name=name,
        title="Throw, default contact" if is_default else "Throw, gentle contact",
        task=mg.tasks.ball_wall().with_softness(softness),
        stddev=settings.angle_stddev,
        points=points,
        num_samples=50,
        has_jump_of_force=is_default,
        descent=Descent(jnp.array([THROW_START]), THROW_STDDEV, THROW_RATE, settings.throw_steps, ["alpha"]),
    )


def _hopper(settings: Settings) -> Problem:
    task = mg.tasks.hopper()
    start = task.initial_params()
    return Problem(
        name="hopper",
        title="Hopper",
        task=task,
        stddev=0.1,
        points=[Point("start", start)],
        num_samples=32,
        has_jump_of_force=True,
        descent=Descent(start, 0.1, HOPPER_RATE, settings.hopper_steps, ["first", "alpha"]),
    )
