r"""Optimal control of a stroke by several methods: a driven ball has to knock another, which it does not touch, to a target.

The cost is $|x_2(T)|^2 + \epsilon \int |u|^2 dt$. Standing still costs 2. The derivative knows nothing of the second ball as
long as the balls do not touch: what solves the task is a force that acts from a distance, or noise under which some rollouts
do touch.

References:
    Zhong, Han, Brikis. Differentiable Physics Simulations with Contacts: Do They Have Correct Gradients w.r.t. Position,
    Velocity and Control? arXiv:2207.05060, task 3. Its optimum for balls that collide in no time is 1.396542.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy.polynomial import Polynomial
from pydantic import Field, model_validator
from scipy.optimize import minimize

import mjxgrad as mg
from experiments.report import MOST_WORDS, Bold, Table, tabulated
from experiments.settings import Positive, RunSettings, SettingsTable, Several, VideoSettings
from experiments.theme import MUTED, Drawings, legend_below, looks, panel
from experiments.video import film, shown_speed
from experiments.words import capitalised, joined
from experiments.workspace import Workspace
from mjxgrad.objective import ParameterNoise, parameter_noise
from mjxgrad.objective.task import InScene, finite_cost
from mjxgrad.rollouts import Trajectory, initial_state, rollout
from mjxgrad.scene import load_scene
from mjxgrad.stepping import Smoothing, own_motion
from mjxgrad.tasks import scene_path


class MethodSettings(SettingsTable):
    """One way to descend, from one start."""

    label: str
    """In legends and tables."""
    estimator: Literal["first_order", "zeroth_order", "alpha_order"] = "first_order"
    """Of `mjxgrad.estimators`."""
    gradient: Literal["discrete", "slope"] = "discrete"
    """Derivative of the steps."""
    start: Positive = 1.3
    """Constant force of the start, in N along each axis; below 1.43 the balls do not touch."""
    stddev: Positive = 1e-6
    """Of the noise on each piece of the force at the start, in N; the default is none to speak of."""
    num_samples: Several = 2
    """Rollouts per step."""
    margin: Positive | None = None
    """By what the contact begins earlier at the start, in m."""
    length: Positive | None = None
    """Of the noise on the distance that the solver averages over at the start, in m."""

    @model_validator(mode="after")
    def _check(self) -> "MethodSettings":
        if self.margin is not None and self.length is not None:
            raise ValueError("margin and length must not be set both")
        return self


class Settings(RunSettings):
    """Cost against steps of several descents on the same stroke."""

    methods: Annotated[tuple[MethodSettings, ...], Field(min_length=1, max_length=10)]
    """In the order of the legend."""
    num_steps: Annotated[int, Field(ge=10)] = 80
    """Of each descent."""
    video: VideoSettings | None = VideoSettings(speed=0.5, width=400, height=400)
    """Of the worst stroke and the best."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        labels = [method.label for method in self.methods]
        if len(set(labels)) < len(labels):
            raise ValueError("labels of methods must differ")
        return self


_PLACE = (-1.0, -1.0)  # of the knocked ball, from which its joints count (m)


class Billiards(InScene):
    r"""The stroke; see `billiards`.

    Attributes:
        target: where the knocked ball should be in the end, in m.
        effort: $\epsilon$, price of the squared force, in m²/(N² s).
        num_pieces: the force is constant over as many pieces of the time.
        horizon: number of steps, a multiple of `num_pieces`.
    """

    target: Float[Array, " 2"]
    effort: Float[Array, ""]
    num_pieces: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True)

    def start(self, force: float = 1.0) -> Float[Array, " dim"]:
        """Return a constant force towards the other ball; below 1.43 N per axis the balls do not touch."""
        return jnp.full(2 * self.num_pieces, force)

    def controls(self, params: Float[Array, " dim"]) -> Float[Array, "horizon 2"]:
        """Return the force at each step, in N, from that of each piece, both axes of a piece side by side."""
        return jnp.repeat(params.reshape(self.num_pieces, 2), self.horizon // self.num_pieces, axis=0)

    def trajectory(self, params: Float[Array, " dim"]) -> Trajectory:
        start = initial_state(self.scene)
        return rollout(self.scene, start, self.controls(params), contact=self.contact)

    def cost(self, params: Float[Array, " dim"]) -> Float[Array, ""]:
        """Return the squared distance to the target plus the price of the effort, in m²; NaN if the rollout diverged."""
        trajectory = self.trajectory(params)
        miss = jnp.array(_PLACE) + trajectory.qpos[-1, 2:] - self.target
        duration = self.horizon * self.scene.model.opt.timestep
        effort = self.effort * duration * jnp.sum(params**2) / self.num_pieces
        return finite_cost(miss @ miss + effort, trajectory)

    def with_margin(self, margin: float | Float[Array, ""]) -> "Billiards":
        """Return the same stroke with a contact that begins at another distance, in m: as if the balls were larger."""
        scene = self.scene.with_model(pair_margin=jnp.full_like(self.scene.model.pair_margin, margin))
        return dataclasses.replace(self, scene=scene)

    def objective(self, stddev: float | Float[Array, ""]) -> ParameterNoise:
        """Return the cost as a function of the forces, with noise on each of them, in N."""
        return parameter_noise(self.cost, stddev, dim=2 * self.num_pieces)


def billiards(*, num_pieces: int = 20) -> Billiards:
    """Load the stroke: the balls are 1.01 m apart, the target is 1.41 m behind the second, and there is one second of time.

    Args:
        num_pieces: the force is constant over as many pieces of the second; with 20 the optimum is dearer by 0.0005 than
            that of a force that may change at any time. It must divide 960, the steps of a second.

    Returns:
        The task; its parameters are the forces, in N.

    Raises:
        ValueError: if `num_pieces` does not divide the steps.
    """
    scene = load_scene(scene_path("billiards"))
    horizon = round(1 / scene.mj_model.opt.timestep)
    if num_pieces < 1 or horizon % num_pieces:
        raise ValueError(f"num_pieces must divide the {horizon} steps of a second, got {num_pieces}")
    return Billiards(scene, jnp.zeros(2), jnp.asarray(0.1), num_pieces, horizon)


# The same stroke with hard balls: closed forms that share no code with the simulation. A driven ball from rest, accelerated by u,
# has to cover the vector d in the time s and arrive at velocity v. The least ∫|u|² for that is 12|d|²/s³ − 12 d·v/s² + 4|v|²/s
# (a force linear in time). Then both balls, of equal mass, exchange what is along the line of centres: the collision is elastic.
DRIVEN, KNOCKED = np.array([-2.0, -2.0]), np.array([-1.0, -1.0])
CONTACT = 0.4  # m, between the centres
EFFORT = 0.1


@functools.cache
def hard_optimum() -> tuple[float, float, float]:
    """Find the best stroke: its cost (m²), the time of the collision (s) and the speed at it (m/s)."""
    gap = np.linalg.norm(KNOCKED - DRIVEN) - CONTACT
    miss = np.linalg.norm(KNOCKED)

    def cost(x):
        time, speed = x
        effort = 12 * gap**2 / time**3 - 12 * gap * speed / time**2 + 4 * speed**2 / time
        return (miss - (1 - time) * speed) ** 2 + EFFORT * effort

    best = minimize(cost, [0.7, 2.5], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14})
    return float(best.fun), float(best.x[0]), float(best.x[1])


def hard_cost(forces: np.ndarray) -> float:
    """Play forces (pieces, 2), in N and constant over pieces of the second, on hard balls; gives the cost (m²)."""
    forces = np.asarray(forces, float)
    piece = 1 / len(forces)
    position, velocity = DRIVEN.copy(), np.zeros(2)
    end = KNOCKED
    for i, force in enumerate(forces):
        way = [Polynomial(along) for along in zip(position - KNOCKED, velocity, force / 2, strict=True)]
        roots = (way[0] ** 2 + way[1] ** 2 - CONTACT**2).roots()
        times = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real >= 0) & (roots.real < piece)]
        if times.size:
            time = times.min()
            normal = -np.array([along(time) for along in way]) / CONTACT
            end = KNOCKED + (1 - i * piece - time) * ((velocity + time * force) @ normal) * normal
            break
        position, velocity = position + piece * velocity + piece**2 / 2 * force, velocity + piece * force
    return float(end @ end + EFFORT * piece * np.sum(forces**2))


IDLE = 2.0  # m², the cost of standing still
_LEARNING_RATE = 0.1  # of Adam, in N; it falls along a cosine to a twentieth
_FINAL_SCALE = 0.02  # left at the last step of noise, margin or length; margin and length are then taken away
_EVALUATIONS = 20  # how often along a descent the true cost is measured


@dataclasses.dataclass(frozen=True)
class Run:
    """One descent; its costs are in m², without noise and with the contact as it is."""

    method: MethodSettings
    steps: np.ndarray  # at which the cost was measured
    cost: np.ndarray
    final_cost: float  # of the best forces that were measured
    hard_cost: float  # of the same forces with balls that collide in no time, by another program
    qpos: np.ndarray  # (states, 4) of the stroke with these forces
    touches_at_start: bool
    num_rollouts: int
    seconds: float
    compile_seconds: float

    @property
    def is_solved(self) -> bool:
        """Whether hard balls, too, are within one per cent of the best."""
        return max(self.final_cost, self.hard_cost) < 1.01 * hard_optimum()[0]

    @property
    def end(self) -> str:
        """In words; there is no progress within one per cent of standing still, or above."""
        return "solved" if self.is_solved else "no progress" if self.final_cost > 0.99 * IDLE else "in between"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """All numbers."""

    settings: Settings
    runs: list[Run]  # one per method

    def rows(self) -> list[dict[str, Any]]:
        """Give the cost along each descent, for metrics.csv."""
        columns = ("final_cost", "hard_cost", "touches_at_start", "num_rollouts", "seconds", "compile_seconds")
        return [
            {"method": run.method.label, "step": int(step), "cost": float(cost)}
            | {name: getattr(run, name) for name in columns}
            for run in self.runs
            for step, cost in zip(run.steps, run.cost, strict=True)
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Descend by every method."""
    task = billiards()
    workspace.check(task.scene)
    play = jax.jit(lambda params: task.trajectory(params).qpos)
    keys = jax.random.split(jax.random.key(settings.seed), len(settings.methods))
    parts = {
        f"{i}": functools.partial(_run, method, task, settings, keys[i], play)
        for i, method in enumerate(settings.methods)
    }
    return Outcome(settings, workspace.each("descents", "methods", parts))


def _run(
    method: MethodSettings, task: Billiards, settings: Settings, key: Array, play: Callable[[Array], Array]
) -> Run:
    every = -(-settings.num_steps // _EVALUATIONS)
    start = task.start(method.start)
    rate = optax.cosine_decay_schedule(_LEARNING_RATE, settings.num_steps, 0.05)
    decay = optax.exponential_decay(1.0, settings.num_steps, _FINAL_SCALE)
    result = mg.optimise(
        _objective(method, task.with_contact(own_motion(method.gradient)), settings),
        start,
        key,
        estimator=functools.partial(getattr(mg.estimators, method.estimator), num_samples=method.num_samples),
        optimiser=optax.adam(rate),
        num_steps=settings.num_steps,
        annealing=decay,
        evaluate=task.cost,
        evaluate_every=every,
    )
    # Where nothing is felt the descent stops early.
    done = int(result.num_steps)
    steps = np.arange(0, done, every)
    return Run(
        method=method,
        steps=np.append(steps, done),
        cost=np.append(np.asarray(result.history.noise_free_cost)[steps], result.final_cost),
        final_cost=float(result.best_cost),
        hard_cost=hard_cost(np.asarray(result.best_params).reshape(-1, 2)),
        qpos=np.asarray(play(result.best_params)),
        touches_at_start=bool(np.any(np.asarray(play(start))[-1, 2:] != 0)),
        num_rollouts=int(result.num_rollouts),
        seconds=result.seconds,
        compile_seconds=result.compile_seconds,
    )


def _objective(
    method: MethodSettings, task: Billiards, settings: Settings
) -> Callable[[Float[Array, ""]], mg.Objective]:
    """From the scale of the smoothing to what is minimised at it."""
    own = task.scene.model.pair_margin[0]
    # In the last tenth of the steps the contact is as it is.
    last = _FINAL_SCALE**0.9

    def objective(scale: Float[Array, ""]) -> mg.Objective:
        smoothed = task
        if method.margin is not None:
            smoothed = task.with_margin(own + jnp.where(scale > last, method.margin * scale, 0.0))
        if method.length is not None:
            smoothed = task.with_contact(Smoothing(jnp.maximum(method.length * scale, 1e-6)))
        return smoothed.objective(method.stddev).with_stddev(method.stddev * scale)

    return objective


def answer(outcome: Outcome) -> str:
    """Name what finds the stroke from balls that do not touch, or what alone does not."""
    apart = [run for run in outcome.runs if not run.touches_at_start]
    if not apart:
        return "Not answered: the balls touch at every start."
    solved, failed = ([f"“{run.method.label}”" for run in apart if run.is_solved is found] for found in (True, False))
    count = f"{len(solved)} of {len(apart)} find it to 1%"
    if not failed or not solved:
        return f"{count}."
    short = f"{count}, but not {joined(failed, 'or')}." if len(failed) < len(solved) else f"{count}: {joined(solved)}."
    return short if len(short.split()) <= MOST_WORDS else f"{count}."


def verdict(outcome: Outcome) -> str:
    """Say what solves the stroke from balls that do not touch, and what does not."""
    apart = [run for run in outcome.runs if not run.touches_at_start]
    solved, stuck, between = (
        [run for run in apart if run.end == end] for end in ("solved", "no progress", "in between")
    )
    sentences = []
    if solved:
        sentences.append(
            f"From balls that do not touch, {_listed(solved)} reach the optimum of {hard_optimum()[0]:.4f} to one per cent, "
            "also when hard balls play their forces."
        )
    if rest := [
        *([f"no progress beyond standing still (cost {IDLE:g}): {_listed(stuck)}"] if stuck else []),
        *([f"in between: {_listed(between)}"] if between else []),
    ]:
        sentences.append(capitalised("; ".join(rest)) + ".")
    touching = [run for run in outcome.runs if run.touches_at_start]
    if touching:
        ends = (f"“{run.method.label}”: {run.end} ({run.final_cost:.3f})" for run in touching)
        sentences.append(f"From a start that touches: {'; '.join(ends)}.")
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say what costs of soft and hard balls mean beside each other."""
    best, time, speed = hard_optimum()
    return [
        f"Hard balls collide in no time (another program: closed forms and root finding); their optimum over all forces is "
        f"{best:.6f}, as published, with a hit after {time:.3f} s at {speed:.2f} m/s. The simulated cost may lie below that by "
        "half a per cent: a soft collision takes time, in which the driven ball goes on pushing."
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    rows = [
        {
            "method": run.method.label,
            "touches at the start": "yes" if run.touches_at_start else "no",
            "cost at the start": f"{run.cost[0]:.4f}",
            "best cost": (Bold if run.is_solved else str)(f"{run.final_cost:.4f}"),
            "with hard balls": f"{run.hard_cost:.4f}",
            "rollouts": str(run.num_rollouts),
            "s": f"{run.seconds:.1f}",
            "s compiling": f"{run.compile_seconds:.1f}",
        }
        for run in outcome.runs
    ]
    return [tabulated(rows, "Costs in m², without noise; bold where the stroke is solved to one per cent.")]


def _listed(runs: list[Run]) -> str:
    return joined(f"“{run.method.label}” ({run.final_cost:.3f})" for run in runs)


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"cost": cost}


def cost(outcome: Outcome):
    """True cost against steps."""
    figure, axis = panel(4.4)
    for run, look in zip(outcome.runs, looks(run.method.label for run in outcome.runs), strict=True):
        style = (0, (4, 2)) if run.touches_at_start else "-"
        axis.plot(run.steps, run.cost, ls=style, ms=4, label=run.method.label, **look)
    for level in (IDLE, hard_optimum()[0]):
        axis.axhline(level, color=MUTED, lw=1.0, ls=(0, (1, 2)), zorder=0)
    axis.set(xlabel="step", ylabel="cost, m²", ylim=(1.3, 2.5))
    legend_below(figure, axis, 3)
    caption = (
        "Cost without noise and with the contact as it is, along each descent. Solid: the balls do not touch at the start; "
        "dashed: they do. Dotted: standing still, and the optimum for hard balls. Descents that coincide cover each other."
    )
    return figure, "Cost against steps", caption


def video(outcome: Outcome, workspace: Workspace, wanted: VideoSettings) -> tuple[str | None, str]:
    """Draw a stroke that stands still and the best one, and give the file and its caption."""
    mj_model = load_scene(scene_path("billiards")).mj_model
    # Without a GPU fine shadows double the time of a frame, and coarse ones speckle the table.
    mj_model.light_castshadow[:] = False
    apart = [run for run in outcome.runs if not run.touches_at_start] or list(outcome.runs)
    chosen = [max(apart, key=lambda run: run.final_cost), min(apart, key=lambda run: run.final_cost)]
    return film(
        workspace,
        [(mj_model, run.qpos) for run in chosen],
        wanted,
        camera="above",
        caption=f"The strokes that two descents end with, {shown_speed(wanted.speed)}; the dark disc is the target.",
        titles=[f"{run.method.label}: {run.final_cost:.3f}" for run in chosen],
        columns=2,
    )
