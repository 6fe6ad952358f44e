"""Descents from starts where nothing touches: which way lets a derivative see what is out of reach, or finds it by chance."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from pydantic import Field

import mjxgrad as mg
from experiments.problems.untouched import Untouched, billiards, hard_cost, hard_optimum, rolling_pin
from experiments.report import MOST_WORDS, Bold, Table, tabulated
from experiments.settings import Finite, Positive, RunSettings, SettingsTable, Several, VideoSettings
from experiments.theme import MUTED, Drawings, legend_below, looks, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.words import capitalised, joined, quantity
from experiments.workspace import Workspace
from mjxgrad.stepping import Smoothing, own_motion

TaskName = Literal["billiards", "rolling_pin"]
_TASKS: dict[TaskName, Callable[[], Untouched]] = {"billiards": billiards, "rolling_pin": rolling_pin}
IDLE: dict[TaskName, float] = {"billiards": 2.0, "rolling_pin": 1.0}  # the cost of what stays untouched
_CAMERAS: dict[TaskName, str] = {"billiards": "above", "rolling_pin": "side"}
_FINAL_SCALE = 0.02  # left of reach at the last step; radius and margin are then taken away
_EVALUATIONS = 60  # how often along a descent the true cost is measured


class MethodSettings(SettingsTable):
    """One way to descend, from one start; the reach of all but proximity shrinks on the way."""

    label: str  # in legends and tables
    estimator: Literal["first_order", "zeroth_order", "alpha_order"] = "first_order"  # of `mjxgrad.estimators`
    gradient: Literal["discrete", "slope"] = "slope"  # derivative of the steps
    start: Finite = 0.0  # control of the start, constant along each axis
    stddev: Positive = 1e-6  # of the noise on each control at the start; the default is none to speak of
    final_noise: Annotated[float, Field(gt=0, le=1)] = 0.02  # share of the noise that is left in the end
    num_samples: Several = 2  # rollouts per step
    proximity: Positive | None = None  # price of the mean squared distance, in distances at the start
    radius: Positive | None = None  # by what the driven body is larger at the start, in m
    margin: Positive | None = None  # by what the contact begins earlier at the start, in m
    length: Positive | None = None  # of the noise on the distance that the solver averages over at the start, in m
    mode: Literal["forward", "backward"] = "forward"  # whether the motion is averaged, too, or its derivative alone


class Settings(RunSettings):
    """Cost against steps and rollouts of several descents on the same task."""

    task: TaskName  # what is to be moved by what does not touch it
    methods: Annotated[tuple[MethodSettings, ...], Field(min_length=1, max_length=10)]  # in the order of the legend
    size: Literal["quick", "default"] = "default"  # the quick size takes the first three methods alone
    num_steps: Annotated[int, Field(ge=10)] = 80  # of each descent
    learning_rate: Positive = 0.1  # of Adam at the start
    # Share of the learning rate that is left in the end, along a cosine.
    final_rate: Annotated[float, Field(gt=0, le=1)] = 0.05
    solved_below: Positive  # cost that counts as solved
    video: VideoSettings | None = None  # of the worst end and the best; without it, none is made


@dataclass(frozen=True)
class Run:
    """One descent; its costs are without noise, of the task as it is."""

    method: MethodSettings
    steps: np.ndarray  # at which the cost was measured
    rollouts: np.ndarray  # spent before these
    cost: np.ndarray
    best_cost: float  # of the best controls that were measured
    hard_cost: float | None  # of a stroke's forces with balls that collide in no time, by another program
    farthest: float  # of what is moved from its target in the end (m)
    qpos: np.ndarray  # states of the motion under these controls
    touches_at_start: bool
    num_skipped: int  # steps without a finite estimate
    seconds: float
    compile_seconds: float

    def steps_to(self, cost: float) -> int | None:
        """Give the first of the measured points from which on the cost stays below another, by its place."""
        above = np.flatnonzero(~(self.cost < cost))
        first = 0 if not above.size else int(above[-1]) + 1
        return first if first < len(self.cost) else None


@dataclass(frozen=True)
class Outcome:
    """All numbers."""

    settings: Settings
    runs: list[Run]  # one per method
    start_gradient: float  # largest element of the gradient of the error at the first method's start

    @property
    def apart(self) -> list[Run]:
        """Give the descents from where nothing touches."""
        return [run for run in self.runs if not run.touches_at_start]

    def is_solved(self, run: Run) -> bool:
        """Say whether a descent solves the task, with hard balls, too."""
        return max(run.best_cost, run.hard_cost or 0.0) < self.settings.solved_below

    def end(self, run: Run) -> str:
        """Give it in words; there is no progress within one per cent of what stays untouched, or above."""
        is_idle = run.best_cost > 0.99 * IDLE[self.settings.task]
        return "solved" if self.is_solved(run) else "no progress" if is_idle else "in between"

    def rows(self) -> list[dict[str, Any]]:
        """Give the cost along each descent, for metrics.csv."""
        columns = ("best_cost", "hard_cost", "farthest", "touches_at_start", "seconds", "compile_seconds")
        return [
            {"method": run.method.label, "step": int(step), "rollouts": int(rollouts), "cost": float(cost)}
            | {name: getattr(run, name) for name in columns}
            for run in self.runs
            for step, rollouts, cost in zip(run.steps, run.rollouts, run.cost, strict=True)
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend by every method."""
    task = _TASKS[settings.task]()
    workspace.check(task.scene)
    play = jax.jit(lambda params: task.trajectory(params).qpos)
    keys = jax.random.split(jax.random.key(settings.seed), len(settings.methods))
    chosen = settings.methods[: 3 if settings.size == "quick" else None]
    parts = {f"{i}": functools.partial(_run, one, task, settings, keys[i], play) for i, one in enumerate(chosen)}
    runs = workspace.each("descents", "methods", parts)
    slope = jax.jit(jax.grad(lambda params: task.error(task.trajectory(params))))(task.start(settings.methods[0].start))
    return Outcome(settings, runs, float(jnp.abs(slope).max()))


class Seen(eqx.Module):
    """What a method minimises at a scale: its numbers are arguments of a program that methods share."""

    task: Untouched
    proximity: Float[Array, ""]
    radius: Float[Array, ""]
    margin: Float[Array, ""]
    length: Float[Array, ""]
    stddev: Float[Array, ""]
    final_noise: Float[Array, ""]
    mode: str | None = eqx.field(static=True)  # of the kernel; None has none

    def __call__(self, scale: Float[Array, ""]) -> mg.Objective:
        # In the last tenth of the steps the scene is as it is.
        reach = jnp.where(scale > _FINAL_SCALE**0.9, scale, 0.0)
        task = self.task.seen_from_afar(self.proximity, reach * self.radius, reach * self.margin)
        task = task if self.mode is None else task.with_contact(Smoothing(scale * self.length, self.mode))
        return task.objective(self.stddev * self.final_noise ** (jnp.log(scale) / np.log(_FINAL_SCALE)))


def _run(
    method: MethodSettings, task: Untouched, settings: Settings, key: Array, play: Callable[[Array], Array]
) -> Run:
    every = -(-settings.num_steps // _EVALUATIONS)
    names = ("proximity", "radius", "margin", "length", "stddev", "final_noise")
    numbers = {name: jnp.asarray(getattr(method, name) or 0.0, float) for name in names}
    start, mode = task.start(method.start), method.mode if method.length else None
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.num_steps, settings.final_rate)
    result = mg.optimise(
        Seen(task.with_contact(own_motion(method.gradient)), **numbers, mode=mode),
        start,
        key,
        estimator=functools.partial(getattr(mg.estimators, method.estimator), num_samples=method.num_samples),
        optimiser=optax.adam(rate),
        num_steps=settings.num_steps,
        annealing=optax.exponential_decay(1.0, settings.num_steps, _FINAL_SCALE),
        evaluate=task.cost,
        evaluate_every=every,
    )
    # Where nothing is felt the descent stops early.
    done, history = int(result.num_steps), result.history
    steps = np.arange(0, done, every)
    qpos, is_stroke = np.asarray(play(result.best_params)), settings.task == "billiards"
    return Run(
        method=method,
        steps=np.append(steps, done),
        rollouts=np.append(0, history.num_rollouts)[np.append(steps, done)],
        cost=np.append(np.asarray(history.noise_free_cost)[steps], result.final_cost),
        best_cost=float(result.best_cost),
        hard_cost=hard_cost(np.asarray(result.best_params).reshape(-1, 2)) if is_stroke else None,
        farthest=float(np.abs(qpos[-1, 2:] - np.asarray(task.target)).max()),
        qpos=qpos,
        touches_at_start=bool(np.any(np.asarray(play(start))[-1, 2:] != 0)),
        num_skipped=int(result.num_skipped),
        seconds=result.seconds,
        compile_seconds=result.compile_seconds,
    )


def answer(outcome: Outcome) -> str:
    """Count the ways that solve the task from where nothing touches, and name the best, or all that do not."""
    solved, failed = ([run for run in outcome.apart if outcome.is_solved(run) is found] for found in (True, False))
    if not outcome.apart:
        return "Not answered: every start touches."
    if not solved:
        return f"None of {len(failed)} ways finds it."
    told = f"{len(solved)} of {len(outcome.apart)} ways find it, best {_listed([min(solved, key=_cost)])}"
    whole = f"{told}; not {joined((f'“{run.method.label}”' for run in failed), 'or')}." if failed else f"{told}."
    return whole if len(whole.split()) <= MOST_WORDS else f"{told}."


def verdict(outcome: Outcome) -> str:
    """Say what solves the task from a start where nothing touches, and what does not."""
    kinds = {}
    for run in sorted(outcome.apart, key=_cost):
        kinds.setdefault(outcome.end(run), []).append(run)
    sentences = []
    if solved := kinds.pop("solved", None):
        hard = ", also when hard balls play their forces" if solved[0].hard_cost else ""
        below = f"a cost below {outcome.settings.solved_below:.5g}"
        sentences.append(f"From a start where nothing touches {below} is reached by {_listed(solved)}{hard}.")
    if kinds:
        rest = "; ".join(f"{end}: {_listed(runs)}" for end, runs in kinds.items())
        sentences.append(f"{capitalised(rest)}; what stays untouched costs {IDLE[outcome.settings.task]:g}.")
    if touching := [run for run in outcome.runs if run.touches_at_start]:
        ends = (f"{_listed([run])}: {outcome.end(run)}" for run in touching)
        sentences.append(f"From a start that touches: {'; '.join(ends)}.")
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say what the derivative knows at the start, what hard balls are, and how many steps had no estimate."""
    size = f"up to {quantity(outcome.start_gradient)}" if outcome.start_gradient else "zero, exactly"
    told = [f"At the first start the derivative of what is to be reached, by every control, is {size}."]
    if outcome.settings.task == "billiards":
        best, time, speed = hard_optimum()
        told.append(
            f"Hard balls collide in no time (another program: closed forms and root finding); their optimum over all forces is "
            f"{best:.6f}, as published, with a hit after {time:.3f} s at {speed:.2f} m/s. The simulated cost may lie below that "
            "by half a per cent: a soft collision takes time, in which the driven ball goes on pushing."
        )
    lost = sum(run.num_skipped for run in outcome.runs)
    return told + [f"{lost} steps were left out, because their estimate was not finite."] * (lost > 0)


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    rows, below = [], f"{outcome.settings.solved_below:.5g}"
    for run in outcome.runs:
        first = run.steps_to(outcome.settings.solved_below)
        row = {
            "method": run.method.label,
            "touches at the start": "yes" if run.touches_at_start else "no",
            "cost at the start": f"{run.cost[0]:.4g}",
            "best cost": (Bold if outcome.is_solved(run) else str)(f"{run.best_cost:.4g}"),
            "final cost": f"{run.cost[-1]:.4g}",
        }
        row |= {} if run.hard_cost is None else {"with hard balls": f"{run.hard_cost:.4g}"}
        row |= {
            f"steps to stay below {below}": "never" if first is None else str(run.steps[first]),
            "rollouts for that": "" if first is None else str(run.rollouts[first]),
            "farthest from its target (mm)": f"{1e3 * run.farthest:.1f}",
            "s": f"{run.seconds:.1f}",
            "s compiling": f"{run.compile_seconds:.1f}",
        }
        rows.append(row)
    caption = "Costs of the task as it is, without noise, whatever a descent saw; in bold what is solved."
    return [tabulated(rows, caption)]


def _cost(run: Run) -> float:
    return run.best_cost


def _listed(runs: list[Run]) -> str:
    return joined(f"“{run.method.label}” ({run.best_cost:.4g})" for run in runs)


def drawings(outcome: Outcome) -> Drawings:
    """Draw true cost against steps and against rollouts."""
    figure, axes = subplots(1, 2, height=4.6, sharey=True)
    left, right = axes[0]
    for run, look in zip(outcome.runs, looks(run.method.label for run in outcome.runs), strict=True):
        look |= {"ls": (0, (4, 2)) if run.touches_at_start else "-", "ms": 4, "markevery": max(1, len(run.steps) // 8)}
        left.plot(run.steps, run.cost, label=run.method.label, **look)
        # The first point has cost no rollout, and a logarithm has no place for it.
        right.plot(run.rollouts[1:], run.cost[1:], **look)
    for axis in (left, right):
        for level in (IDLE[outcome.settings.task], outcome.settings.solved_below):
            axis.axhline(level, color=MUTED, lw=1.0, ls=(0, (1, 2)), zorder=0)
    lowest = min(run.best_cost for run in outcome.runs)
    scale = "log" if lowest < IDLE[outcome.settings.task] / 10 else "linear"
    left.set(title="Against steps", xlabel="step", ylabel="cost", yscale=scale)
    right.set(title="Against rollouts", xlabel="rollouts", xscale="log")
    legend_below(figure, left, 4)
    caption = (
        "Cost without noise and of the task as it is, along each descent. Solid: nothing touches at the start; dashed: something "
        "does. Dotted: what stays untouched, and what counts as solved. Descents that coincide cover each other. What reaches "
        f"out shrinks to {_FINAL_SCALE:.0%} on the way, so that what is seen becomes what is."
    )
    return {"cost": (figure, "Cost against steps and rollouts", caption)}


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw the worst end and the best from where nothing touches, and give the file and its caption."""
    model, runs = with_coarse_shadows(_TASKS[outcome.settings.task]().scene.mj_model), outcome.apart or outcome.runs
    chosen = [max(runs, key=_cost), min(runs, key=_cost)]
    return film(
        workspace,
        [(model, run.qpos) for run in chosen],
        wanted,
        camera=_CAMERAS[outcome.settings.task],
        caption=f"The motions that two descents end with, {shown_speed(wanted.speed)}; the target is marked.",
        titles=[f"{run.method.label}: {run.best_cost:.4g}" for run in chosen],
        columns=2,
    )
