"""The risk bench: squared errors of α-order and of the parts that it mixes, on closed forms, tasks and robots."""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from pydantic import Field

import mjxgrad as mg
from experiments.motion import own_task
from experiments.optimisation.published import TASKS
from experiments.problems import ASSETS, textbook
from experiments.problems.comparison import over_keys
from experiments.report import Bold, Table, tabulated
from experiments.settings import OwnScene, Positive, RunSettings
from experiments.theme import FIRST, MUTED, ONSET, ZEROTH, Drawings, subplots
from experiments.words import percent, quantity
from experiments.workspace import Workspace
from mjxgrad.checking.motions import half_range
from mjxgrad.estimators import rules
from mjxgrad.estimators.mixture import both_parts, weigh
from mjxgrad.estimators.samples import Plan, Samples, plan_by_noise, sample
from mjxgrad.objective import Objective, as_vector
from mjxgrad.tasks import wall_softness

RobotName = Literal["hopper", "walker2d", "half_cheetah", "ant"]
TextbookName = Literal["heaviside", "soft_heaviside", "quadratic_sine"]
TaskName = Literal["push_soft", "push_stiff", "friction", "lqr", "motion_planning", "tennis"]
FIRST_ORDER, ZEROTH_ORDER, ALPHA = "first order", "zeroth order", "α-order"
_RULES: dict[str, rules.Rule] = {
    "control variate": rules.FixedAlpha(0.0),
    "inverse variance": rules.InverseVariance(),
    "concavity (DDCG)": rules.Concavity(),
    "trust region": rules.TrustRegion(),
    ALPHA: rules.LeastRisk(),
}
METHODS = (FIRST_ORDER, ZEROTH_ORDER, *_RULES)
_CONTACTS = {"discrete": mg.Discrete(), "slope": mg.Slope()}
_PART = 256  # rollouts that are made at a time
_RESAMPLES = 400


class Settings(OwnScene, RunSettings):
    """Mean squared errors of estimates, over batches of the same rollouts."""

    # Costs of one number with closed forms, also as the sum over many.
    textbook: tuple[TextbookName, ...] = ("heaviside", "soft_heaviside", "quadratic_sine")
    points: tuple[float, ...] = (0.0, 0.1, 0.2)  # where these are estimated, for a width of 0.1 of the noise
    dims: tuple[Annotated[int, Field(ge=1)], ...] = (1, 40)  # over how many numbers they are summed
    # Published tasks, at their start and later.
    tasks: tuple[TaskName, ...] = ("push_soft", "push_stiff", "friction", "lqr", "motion_planning", "tennis")
    # Steps of their descent by an unbiased estimate, after which they are measured once more.
    later: Annotated[int, Field(ge=0)] = 60
    walls: tuple[Positive, ...] = (1e2, 1e3, 1e4, 1e5)  # stiffness of the wall in a throw (1/s²)
    # Angles of throws (rad) whose contacts, MuJoCo's default ones, set in with a jump of force; by both derivatives.
    throws: tuple[Positive, ...] = (0.5, 0.8, 0.95)
    # Of gymnasium, by C MuJoCo; their controls under noise, by both derivatives.
    robots: tuple[RobotName, ...] = ("hopper", "walker2d", "half_cheetah", "ant")
    stddev: Positive = 0.3  # of the noise on controls, in halves of their range
    # Samples of an estimate.
    batches: Annotated[tuple[Annotated[int, Field(ge=4)], ...], Field(min_length=1)] = (16, 64, 256)
    # Rollouts that are differentiated, in all batches together; on robots a quarter, on closed forms four times as many.
    num_samples: Annotated[int, Field(ge=512)] = 4096
    # Rollouts without derivatives that the truth of robots is from.
    num_truth: Annotated[int, Field(ge=4000)] = 64_000


@dataclass(frozen=True)
class Cell:
    """One problem with one derivative, estimated by batches of one size."""

    problem: str
    derivative: str
    dim: int
    batch: int
    error: dict[str, float]  # mean squared errors by method, over the squared norm of the truth
    spread: dict[str, float]  # their standard errors over batches
    ratio_interval: tuple[float, float]  # of the ratio, of 95 %, by resampling batches
    alpha: float  # mean weight of α-order
    bias: float  # that of first order, over the norm of the truth, by all samples; zero where noise hides it
    truth_error: float  # squared error of the truth, over its squared norm; taken off from all errors

    def over_better(self, name: str) -> float:
        """Return the error of a method over that of the better of first and zeroth order."""
        better = min(self.error[FIRST_ORDER], self.error[ZEROTH_ORDER])
        return max(self.error[name], 1e-300) / max(better, 1e-300)

    @property
    def ratio(self) -> float:
        """That of α-order."""
        return self.over_better(ALPHA)


@dataclass(frozen=True)
class Outcome:
    """All cells."""

    settings: Settings
    cells: list[Cell]

    def rows(self) -> list[dict[str, Any]]:
        """One row per cell, for metrics.csv."""
        names = ("problem", "derivative", "dim", "batch", "ratio", "alpha", "bias", "truth_error")
        return [
            {name: getattr(cell, name) for name in names}
            | {f"error, {name}": value for name, value in cell.error.items()}
            for cell in self.cells
        ]

    @property
    def told(self) -> list[Cell]:
        """Those whose truth is known better than the better part."""
        return [
            cell for cell in self.cells if min(cell.error[FIRST_ORDER], cell.error[ZEROTH_ORDER]) > cell.truth_error
        ]

    @property
    def ratios(self) -> np.ndarray:
        """Errors of α-order over those of the better part, in the cells that tell."""
        return np.array([cell.ratio for cell in self.told])


@dataclass(frozen=True)
class _Problem:
    name: str
    derivative: str
    objective: Objective
    params: Array
    truth: Callable[[], tuple[np.ndarray, float]]  # with its squared error
    num_samples: int


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Estimate each problem by batches of its rollouts."""
    parts = {
        f"{i}": functools.partial(_cells, make, settings, jax.random.key(settings.seed + i))
        for i, make in enumerate(_problems(settings))
    }
    return Outcome(settings, list(itertools.chain(*workspace.each("estimates", "problems", parts))))


def _problems(settings: Settings) -> list[Callable[[], _Problem]]:
    if settings.scene is not None:
        return [functools.partial(_own, settings, name) for name in _CONTACTS]
    swept = {
        _closed_form: (settings.textbook, settings.points, settings.dims),
        _published: (settings.tasks, (0, settings.later)),
        _throw: (settings.walls,),
        _default_throw: (settings.throws, _CONTACTS),
        _robot: (settings.robots, _CONTACTS),
    }
    return [functools.partial(make, settings, *each) for make, by in swept.items() for each in itertools.product(*by)]


def _closed_form(settings: Settings, name: str, at: float, dim: int) -> _Problem:
    kinds = {
        "heaviside": textbook.Heaviside,
        "soft_heaviside": lambda: textbook.SoftHeaviside(0.01),
        "quadratic_sine": lambda: textbook.QuadraticSine(0.1, 40.0),
    }
    one = kinds[name]()
    objective = mg.parameter_noise(lambda x: jax.vmap(one)(x[:, None]).sum(), 0.1, dim)
    exact = np.full(dim, float(one.gradient(at, 0.1)))
    title = f"{name.replace('_', ' ')} at {at:g}" + (f", {dim} of them" if dim > 1 else "")
    return _Problem(title, "exact", objective, jnp.full(dim, at), lambda: (exact, 0.0), 4 * settings.num_samples)


def _published(settings: Settings, name: str, steps: int) -> _Problem:
    task = TASKS[name]()
    params = task.params
    if steps:
        unbiased = functools.partial(mg.estimators.control_variate, num_samples=100)
        key = jax.random.key(settings.seed + 1)
        optimiser = optax.sgd(task.learning_rate)  # pyright: ignore[reportArgumentType]
        params = mg.optimise(
            task.objective, params, key, estimator=unbiased, optimiser=optimiser, num_steps=steps
        ).params
    title = name.replace("_", " ") + (f", step {steps}" if steps else "")
    truth = functools.partial(_by_many, settings, task.objective, params, mg.estimators.control_variate)
    return _Problem(title, "exact", task.objective, params, truth, settings.num_samples)


def _throw(settings: Settings, stiffness: float) -> _Problem:
    objective = mg.tasks.ball_wall().objective(softness=wall_softness(stiffness))
    return _thrown(settings, f"throw, wall of {stiffness:g} 1/s²", "discrete", objective, 0.6)


def _default_throw(settings: Settings, angle: float, kind: str) -> _Problem:
    softness = mg.Softness(stiffness=2500.0, damping_ratio=1.0, impedance=(0.9, 0.95), width=0.001)
    objective = mg.tasks.ball_wall().with_contact(_CONTACTS[kind]).objective(0.05, softness)
    return _thrown(settings, f"throw at {angle:g} rad, default contact", kind, objective, angle)


def _thrown(settings: Settings, title: str, kind: str, objective: Objective, angle: float) -> _Problem:
    params = jnp.array([angle])
    truth = functools.partial(_by_many, settings, objective, params, mg.estimators.control_variate)
    return _Problem(title, kind, objective, params, truth, settings.num_samples // 2)


# Time steps of a rollout.
_HORIZONS = {"hopper": 50, "walker2d": 50, "half_cheetah": 50, "ant": 30}


def _robot(settings: Settings, name: str, kind: str) -> _Problem:
    scene = mg.load_scene(str(ASSETS / f"{name}.xml")).with_engine("mujoco")
    start, forwards = mg.initial_state(scene), lambda trajectory: -trajectory.qpos[-1, 0]
    task = mg.SceneTask(scene, start, forwards, horizon=_HORIZONS[name])  # pyright: ignore[reportCallIssue]
    return _of_task(settings, name, kind, task)


def _own(settings: Settings, kind: str) -> _Problem:
    task = own_task(settings)
    return _of_task(settings, Path(str(settings.scene)).stem, kind, task.with_engine("mujoco"))


def _of_task(settings: Settings, name: str, kind: str, task: mg.SceneTask) -> _Problem:
    contact = _CONTACTS[kind]
    model = task.scene.model
    middle = np.where(model.actuator_ctrllimited, np.mean(model.actuator_ctrlrange, axis=1), 0.0)
    width = settings.stddev * jnp.broadcast_to(jnp.asarray(half_range(task.scene)), (task.horizon, len(middle)))
    objective = mg.open_loop(task.with_contact(contact), width)
    params = jnp.tile(jnp.asarray(middle), task.horizon)
    truth = functools.partial(_by_many, settings, mg.open_loop(task, width), params, _antithetic)
    return _Problem(name.replace("_", " "), kind, objective, params, truth, settings.num_samples // 4)


_antithetic = functools.partial(mg.estimators.zeroth_order, antithetic=True)


def _by_many(settings: Settings, objective: Objective, params: Array, estimator: Callable) -> tuple[np.ndarray, float]:
    """Return the mean of large unbiased estimates, and its squared error."""
    keys = jax.random.split(jax.random.key(settings.seed + 2), max(2, settings.num_truth // 2000))
    found = np.asarray(over_keys(estimator, objective, params, keys, num_samples=2000).value, float)
    return found.mean(axis=0), float(found.var(axis=0, ddof=1).sum() / len(found))


def _cells(make: Callable[[], _Problem], settings: Settings, key: Array) -> list[Cell]:
    problem = make()
    objective, params, _ = as_vector(problem.objective, problem.params)
    plan = plan_by_noise(objective, _PART, None)
    roll_out = jax.jit(lambda key: sample(objective, params, key, plan, jnp.arange(plan.num_units)))
    parts = [jax.device_get(roll_out(k)) for k in jax.random.split(key, max(2, problem.num_samples // _PART))]
    samples = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    truth, truth_error = problem.truth()
    cells = []
    for batch in settings.batches:
        size = batch // plan.rollouts_per_unit
        count = len(samples.is_noisy) // size
        if count < 4:
            continue
        split = jax.tree.map(lambda leaf, n=count, m=size: leaf[: n * m].reshape(n, m, *leaf.shape[1:]), samples)
        values, alpha = _estimates(plan, split)
        cells.append(_cell(problem, batch, jax.device_get(values), alpha, truth, truth_error))
    return cells


@functools.partial(jax.jit, static_argnums=0)
def _estimates(plan: Plan, batches: Samples) -> tuple[dict[str, Float[Array, "batches dim"]], Float[Array, " batches"]]:
    """Return each method's estimates, one for each batch, and the weights of α-order."""

    def one(batch: Samples) -> tuple[dict[str, Array], Array]:
        parts, plain = (both_parts(batch, control_variate=with_derivatives) for with_derivatives in (True, False))
        alphas = {name: weigh(rule, parts, plan).alpha for name, rule in _RULES.items()}
        mixed = {name: parts.mixture(alpha)[0] for name, alpha in alphas.items()}
        return {FIRST_ORDER: parts.first.mean, ZEROTH_ORDER: plain.unbiased.mean, **mixed}, alphas[ALPHA]

    return jax.lax.map(one, batches)


def _bias(first: Float[np.ndarray, "batches dim"], truth: np.ndarray, truth_error: float) -> float:
    """Return the norm of a mean's distance from the truth over that of the truth, without what noise adds to its square."""
    noise = first.var(axis=0, ddof=1).sum() / len(first) + truth_error
    square = np.sum((first.mean(axis=0) - truth) ** 2) - noise
    return float(np.sqrt(max(square, 0) / max(np.sum(truth**2) - truth_error, 1e-300)))


def _cell(
    problem: _Problem, batch: int, values: dict[str, Any], alpha: Any, truth: np.ndarray, truth_error: float
) -> Cell:
    squares = {
        name: ((np.asarray(value, float) - truth) ** 2).sum(axis=1) - truth_error for name, value in values.items()
    }
    scale = max(float((truth**2).sum()) - truth_error, 1e-300)
    number = len(squares[ALPHA])

    def ratio(rows: np.ndarray) -> float:
        means = {name: max(float(squares[name][rows].mean()), 1e-300) for name in (FIRST_ORDER, ZEROTH_ORDER, ALPHA)}
        return means[ALPHA] / min(means[FIRST_ORDER], means[ZEROTH_ORDER])

    rng = np.random.default_rng(0)
    resampled = [ratio(rng.integers(0, number, number)) for _ in range(_RESAMPLES)]
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Cell(
        problem.name,
        problem.derivative,
        truth.size,
        batch,
        {name: float(x.mean() / scale) for name, x in squares.items()},
        {name: float(x.std(ddof=1) / np.sqrt(number) / scale) for name, x in squares.items()},
        (float(low), float(high)),
        float(np.mean(alpha)),
        _bias(np.asarray(values[FIRST_ORDER], float), truth, truth_error),
        truth_error / scale,
    )


def answer(outcome: Outcome) -> str:
    """Say how α-order compares with the better part."""
    near, worst = (outcome.ratios <= 1.1).mean(), outcome.ratios.max()
    return f"{percent(near)} of cells within 1.1 times the better part's error, worst {worst:.2f}."


def verdict(outcome: Outcome) -> str:
    """Say where α-order helps, what it costs, and how others do."""
    cells = outcome.told
    below = [cell for cell in cells if cell.ratio_interval[1] < 0.9]
    worst = cells[int(outcome.ratios.argmax())]
    others = []
    for name in METHODS[:-1]:
        ratios = np.array([cell.over_better(name) for cell in cells])
        others.append(f"{name} {percent((ratios <= 1.1).mean())} and {quantity(ratios.max())}")
    return (
        f"In {len(below)} of {len(cells)} cells α-order is below both parts, beyond chance and by more than a tenth; it is worst "
        f"on {worst.problem} ({worst.derivative}, {worst.batch} samples): {worst.ratio:.2f} times the better part. "
        f"Within 1.1 times, and worst, of the others: {'; '.join(others)}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what is left out."""
    left = len(outcome.cells) - len(outcome.told)
    return (
        [f"{left} of {len(outcome.cells)} cells are not counted: the better part's error is below that of the truth."]
        if left
        else []
    )


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all cells."""
    shown = (FIRST_ORDER, ZEROTH_ORDER, "control variate", "concavity (DDCG)", ALPHA)
    rows = []
    for cell in outcome.told:
        low, high = cell.ratio_interval
        row = {"problem": cell.problem, "derivative": cell.derivative}
        row |= {"numbers": str(cell.dim), "samples": str(cell.batch)}
        row |= {name: quantity(cell.error[name]) for name in shown}
        row |= {"bias of first order": percent(cell.bias), "α": f"{cell.alpha:.2f}"}
        ratio = (Bold if high < 0.9 else str)(f"{cell.ratio:.2f} ({low:.2f} to {high:.2f})")
        rows.append(row | {"α-order over the better part": ratio})
    caption = (
        "Mean squared errors over the squared norm of the gradient. Intervals are of 95 %, over batches. In bold, α-order is "
        "below both parts by more than a tenth."
    )
    return [tabulated(rows, caption)]


def drawings(outcome: Outcome) -> Drawings:
    """Draw errors of all parts and of α-order over the better part's, sorted."""
    figure, axes = subplots(1, len(outcome.settings.batches), height=4.6, sharey=True)
    looks = {
        FIRST_ORDER: {"color": FIRST, "marker": "o"},
        ZEROTH_ORDER: {"color": ZEROTH, "marker": "s"},
        "concavity (DDCG)": {"color": MUTED, "marker": "x"},
        ALPHA: {"color": ONSET, "marker": "D"},
    }
    for axis, batch in zip(axes[0], outcome.settings.batches, strict=True):
        cells = sorted(
            (c for c in outcome.told if c.batch == batch),
            key=lambda c: c.error[FIRST_ORDER] / max(c.error[ZEROTH_ORDER], 1e-300),
        )
        for name, look in looks.items():
            heights = [min(cell.over_better(name), 1e4) for cell in cells]
            axis.plot(range(len(cells)), heights, ls="", ms=4.5 if name == ALPHA else 3.5, label=name, **look)
        axis.axhline(1, color=MUTED, lw=0.8)
        axis.set(title=f"{batch} samples", yscale="log", xticks=[])
        axis.set_xlabel("problems, from first order's to zeroth order's")
    axes[0][0].set_ylabel("squared error over that of the better part")
    axes[0][0].legend(loc="upper center", fontsize=8.5)
    caption = (
        "Each column is one problem with one derivative: left, where first order is far ahead, right, where zeroth order is. "
        "α-order stays near 1 or below; each of the others is far above on one side."
    )
    return {"risk": (figure, "Squared errors over those of the better part", caption)}
