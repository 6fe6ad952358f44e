"""Gradients over ever longer horizons: growth of derivatives, first order's variance beside zeroth order's, and windows."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from matplotlib.ticker import NullFormatter
from pydantic import Field

import mjxgrad as mg
from experiments.problems import ASSETS
from experiments.problems.comparison import over_keys
from experiments.report import Table
from experiments.settings import RunSettings
from experiments.theme import FIRST, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.words import capitalised, quantity
from experiments.workspace import Workspace
from mjxgrad.diagnostics.bias_variance import map_in_chunks
from mjxgrad.stepping import Contact
from mjxgrad.tasks import scene_path


class Settings(RunSettings):
    """Gradients by noisy controls against the horizon; errors are those of estimates from 16 rollouts."""

    # How many rollouts and estimates; the quick size has a quarter, α at two horizons, and leaves the hopper's slope out.
    size: Literal["quick", "default"] = "default"
    num_controls: Annotated[int, Field(ge=8)] = 30  # in time, each held for ten steps
    # Rollouts that are differentiated; 32 times as many are for the truth and the value function.
    num_samples: Annotated[int, Field(ge=128)] = 192

    def sized(self, number: int) -> int:
        """Return a number of rollouts or estimates, or its quarter."""
        return number // (4 if self.size == "quick" else 1)


HELD, BATCH = 10, 16  # steps; rollouts
# Of the hopper, whose bent legs absorb the landing: with the downward speed its foot lands after 70 ms.
_POSE, _SPEED = (0.0, 1.22, 0.0, -0.4, -0.5, 0.3), (0.5, -1.0, 0.0, 0.0, 0.0, 0.0)
COLUMNS = FIRST_VARIANCE, ZEROTH_VARIANCE, SIZE, GROWTH = "first order", "zeroth order", "squared gradient", "growth"


@dataclass(frozen=True)
class Problem:
    """A scene under held controls with noise; the cost is of the state (qpos, qvel) at the horizon, as what a value sees."""

    title: str
    scene: mg.Scene
    start: Float[Array, " n"]
    cost: Callable[[Float[Array, " n"]], Float[Array, ""]]
    observe: Callable[[Float[Array, " n"]], Float[Array, " features"]]
    contact: Contact = mg.Discrete()
    stddev: float = 0.1

    def states(self, controls: Float[Array, "times nu"], start: Float[Array, " n"]) -> Float[Array, "times n"]:
        """Return the states at the ends of the controls."""
        state = mg.initial_state(self.scene, *jnp.split(start, [self.scene.model.nq]))
        found = mg.rollout(self.scene, state, jnp.repeat(controls, HELD, axis=0), contact=self.contact)
        return jnp.concatenate([found.qpos, found.qvel], axis=1)[HELD::HELD]


def problems() -> list[Problem]:
    """Return a pendulum that swings over, and a hopper that lands on springs, which hold its posture, by both derivatives."""
    pendulum = mg.load_scene(scene_path("double_pendulum"), timestep=0.01).with_engine("mujoco")
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "hopper.xml"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model.jnt_stiffness[3:], model.qpos_spring[3:], model.dof_damping[3:] = 100.0, _POSE[3:], 10.0
    hopper = mg.load_scene(model).with_engine("mujoco")

    def sideways(x: Float[Array, " 4"]) -> Float[Array, ""]:
        return 0.3 * (jnp.sin(x[0]) + jnp.sin(x[0] + x[1]))  # m, of the tip

    def turns(x: Float[Array, " 4"]) -> Float[Array, " 6"]:
        angles = jnp.stack([x[0], x[0] + x[1]])
        return jnp.concatenate([jnp.sin(angles), jnp.cos(angles), x[2:]])

    lands = hopper, jnp.array(_POSE + _SPEED), lambda x: -x[0] - x[1], lambda x: x
    return [
        Problem("double pendulum", pendulum, jnp.array([2.4, 0.5, 0.0, 0.0]), sideways, turns),
        Problem("hopper, discrete", *lands),
        Problem("hopper, slope", *lands, contact=mg.Slope()),
    ]


@dataclass(frozen=True)
class Found:
    """What was measured on a problem, by horizon (s): the variances of one rollout, summed over controls, and more.

    Growth is the largest singular value of the derivative by the start, in the median; its rate over the last half (1/s) has a
    standard error. From the crossing on, with its interval, first order's variance is above zeroth order's. Of α-order: mean α,
    and the squared error over the better part's. Of windows: (error, bias) by (without a value function, with it). Windows and
    α are by their number of controls; errors are of a batch, over the size of the gradient of the mean cost.
    """

    title: str
    times: np.ndarray
    columns: dict[str, np.ndarray]
    rate: tuple[float, float]
    crossing: tuple[float, float, float]
    alphas: dict[int, tuple[float, float]]
    windows: dict[int, np.ndarray]
    zeroth_error: float


@dataclass(frozen=True)
class Outcome:
    """All that was found."""

    found: list[Found]

    def rows(self) -> list[dict[str, Any]]:
        """One row per problem and horizon, for metrics.csv."""
        return [
            {"problem": one.title, "horizon": time} | {name: values[i] for name, values in one.columns.items()}
            for one in self.found
            for i, time in enumerate(one.times)
        ]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every problem."""
    chosen = problems()[: 2 if settings.size == "quick" else None]
    parts = {one.title: functools.partial(measured, one, settings) for one in chosen}
    return Outcome(workspace.each("horizons", "problems", parts))


def measured(one: Problem, settings: Settings) -> Found:
    """Measure growth, variances, α-order and windows."""
    rng, horizon, stddev = np.random.default_rng(settings.seed), settings.num_controls, one.stddev
    count = settings.sized(settings.num_samples)
    many, noise = (stddev * rng.normal(size=(n, horizon, one.scene.model.nu)) for n in (32 * count, count))
    states = _in_parts(lambda u: one.states(u, one.start), many, 512)
    value, costs = fitted(one, states, rng), _costs(one, states)[0]
    truths = [scored(costs, many / stddev**2, t) for t in (*range(horizon), None)]
    with_derivative = lambda u: (one.states(u, one.start), jax.jacfwd(one.states, (0, 1))(u, one.start))  # noqa: E731
    states, (by_control, by_start) = _in_parts(with_derivative, noise, 64)
    costs, slopes = _costs(one, states)
    charged, ahead = (np.einsum("sti,stiku->tsku", by, by_control) for by in (slopes, value(states)))
    *zeroth, zeroth_of_mean = [scored(costs, noise / stddev**2, t) for t in (*range(horizon), None)]
    squares = [np.stack([((x - x.mean(0)) ** 2).sum((1, 2)) for x in each]) for each in (charged, zeroth)]
    times = one.scene.mj_model.opt.timestep * HELD * np.arange(1, horizon + 1)
    draws = [np.arange(count), *rng.integers(count, size=(300, count))]
    crossings = [last_crossing(times, np.log(squares[0][:, d].mean(1) / squares[1][:, d].mean(1))) for d in draws]
    grown = np.linalg.norm(by_start, ord=2, axis=(2, 3))
    rates = np.polyfit(times[horizon // 2 :], np.log(grown[:, horizon // 2 :]).T, 1)[0]
    size = np.array([np.maximum((x.mean(0) ** 2).sum() - _spread(x) / len(x), 0) for x in truths])
    alphas, shares = {}, (0.3, 1.0) if settings.size == "quick" else (0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
    for n in sorted({round(horizon * share) for share in shares}):
        better = min(errors(x[n - 1], truths[n - 1])[0] for x in (charged, zeroth))
        alpha, square = _by_alpha(one, truths[n - 1].mean(0)[:n], settings)
        alphas[n] = alpha, max(square - _spread(truths[n - 1]) / len(many), 0) / better
    lengths = [n for n in (1, 2, 4, 8, 16) if n < horizon] + [horizon]
    windows = {n: [errors(x, truths[-1]) for x in windowed(charged, ahead, n)] for n in lengths}
    columns = [*(x.mean(1) for x in squares), size[:-1], np.median(grown, axis=0)]
    return Found(
        one.title,
        times,
        dict(zip(COLUMNS, columns, strict=True)),
        (float(rates.mean()), float(rates.std(ddof=1) / np.sqrt(count))),
        (crossings[0], *np.quantile(crossings[1:], [0.025, 0.975], method="nearest").tolist()),
        alphas,
        {n: np.sqrt(np.array(found).T / size[-1]) for n, found in windows.items()},
        float(np.sqrt(errors(zeroth_of_mean, truths[-1])[0] / size[-1])),
    )


def _in_parts(function: Callable, noise: np.ndarray, count: int) -> Any:
    """Map over noise in parts, so that memory does not grow."""
    return jax.tree.map(np.asarray, jax.jit(lambda each: map_in_chunks(function, each, count))(noise))


def _costs(one: Problem, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return jax.tree.map(np.asarray, jax.vmap(jax.vmap(jax.value_and_grad(one.cost)))(states))


def _spread(samples: np.ndarray) -> float:
    return float(samples.var(axis=0, ddof=1).sum())


def errors(samples: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the squared error of the mean of a batch, and the squared bias, from samples and from those of the truth."""
    noise = _spread(samples) / len(samples) + _spread(truth) / len(truth)
    bias = max(((samples.mean(0) - truth.mean(0)) ** 2).sum() - noise, 0.0)
    return bias + _spread(samples) / BATCH, bias


def scored(costs: np.ndarray, scores: np.ndarray, time: int | None) -> np.ndarray:
    """Return samples (rollouts, controls, nu) of the zeroth-order gradient of the cost at a time, or of the mean cost."""
    charged = (costs - costs.mean(0)) * len(costs) / (len(costs) - 1)
    charged = charged / costs.shape[1] if time is None else charged * (np.arange(costs.shape[1]) == time)
    # A control has no effect on the costs before it.
    return charged[:, ::-1].cumsum(axis=1)[:, ::-1, None] * scores


def windowed(charged: np.ndarray, ahead: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return samples of the gradient of the mean cost by windows of some controls, without and with a value at their ends.

    A window charges the costs in it, and begins where the last one ended, without its derivative (SHAC, Xu et al.,
    arXiv:2204.07137). Arguments are derivatives of costs and of values (times, rollouts, controls, nu).
    """
    window = np.arange(len(charged)) // length
    own = (window[:, None] == window)[:, None, :, None]
    is_end = (np.diff(window, append=window[-1]) > 0)[:, None, None, None]
    plain = (charged * own).sum(0) / len(charged)
    return plain, plain + (ahead * (own & is_end)).sum(0) / len(charged)


def fitted(one: Problem, states: np.ndarray, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Fit the sum of later costs at each time by 200 random waves of what is observed; gives slopes (rollouts, times, n)."""
    costs, seen = _costs(one, states)[0], np.asarray(jax.vmap(jax.vmap(one.observe))(jnp.asarray(states)))
    later, centre, size = costs[:, ::-1].cumsum(axis=1)[:, ::-1] - costs, seen.mean(0), seen.std(0) + 1e-9
    turns, phases = rng.normal(size=(200, seen.shape[-1])) / 2, rng.uniform(0, 2 * np.pi, 200)

    def value(x: Array, centre: Any, size: Any, weights: Any) -> Array:
        z = (one.observe(x) - centre) / size
        return jnp.concatenate([jnp.ones(1), z, jnp.cos(turns @ z + phases)]) @ weights

    number = 201 + seen.shape[-1]
    waves = jax.jit(jax.vmap(value, (0, None, None, None)))
    every = (
        np.asarray(waves(jnp.asarray(states[:, t]), centre[t], size[t], jnp.eye(number))) for t in range(len(centre))
    )
    ridge = 1e-6 * len(states) * np.eye(number)
    weights = np.array([np.linalg.solve(x.T @ x + ridge, x.T @ y) for x, y in zip(every, later.T, strict=True)])
    slopes = jax.jit(jax.vmap(jax.vmap(jax.grad(value)), (0, None, None, None)))
    return lambda at: np.asarray(slopes(at, centre, size, weights))


def _by_alpha(one: Problem, truth: np.ndarray, settings: Settings) -> tuple[float, float]:
    """Return the mean α, and the mean squared error, of many estimates."""
    cost = lambda flat: one.cost(one.states(flat.reshape(truth.shape), one.start)[-1])  # noqa: E731
    objective = mg.parameter_noise(cost, one.stddev, truth.size)
    keys = jax.random.split(jax.random.key(settings.seed), settings.sized(32))
    found = over_keys(mg.estimators.alpha_order, objective, jnp.zeros(truth.size), keys, BATCH)
    return float(found.alpha.mean()), float(((found.value - truth.ravel()) ** 2).sum(axis=1).mean())


def last_crossing(times: np.ndarray, log_ratio: np.ndarray) -> float:
    """Return the interpolated time from which a ratio stays above one; infinite if it ends below, the first if always above."""
    below = np.flatnonzero(log_ratio < 0)
    if not len(below) or below[-1] == len(times) - 1:
        return np.inf if len(below) else float(times[0])
    return float(np.interp(0, log_ratio[below[-1] :][:2], times[below[-1] :][:2]))


def answer(outcome: Outcome) -> str:
    """Say up to which horizon first order has less variance."""
    found = [(one.title, one.crossing[0]) for one in outcome.found]
    ends = [f"{title}: {f'to {end:.2g} s' if np.isfinite(end) else 'always'}" for title, end in found]
    return f"{capitalised('; '.join(ends))}."


def verdict(outcome: Outcome) -> str:
    """Say what grows, and what windows with a value function do."""
    told = []
    for one in outcome.found:
        n = min(one.windows, key=lambda n: one.windows[n][0, 1])
        (without, error), (cut, bias) = one.windows[n]
        told.append(
            f"{one.title}: derivatives grow by {quantity(*one.rate)} 1/s; windows of {one.times[n - 1]:.2g} s with a value "
            f"function are {error:.2g} of the gradient off (bias {bias:.2g}), without one {without:.2g} (bias {cut:.2g}), the "
            f"whole horizon {one.windows[len(one.times)][0, 0]:.2g}, zeroth order {one.zeroth_error:.2g}; α-order has at most "
            f"{max(x for _, x in one.alphas.values()):.2g} times the better part's squared error"
        )
    return capitalised("; ".join(told)) + "."


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate windows."""
    rows = [
        [one.title, f"{one.times[n - 1]:.2g}", *(f"{x:.2g}" for x in (*found.T.ravel(), one.zeroth_error))]
        for one in outcome.found
        for n, found in one.windows.items()
    ]
    columns = ("problem", "window, s", "error", "bias", "error, value", "bias, value", "error, zeroth order")
    caption = "Over the size of the gradient of the mean cost; errors from 16 rollouts. The last window is the horizon."
    return [Table(columns, rows, caption)]


def drawings(outcome: Outcome) -> Drawings:
    """Draw variances against the horizon with their crossings and α; errors by windows."""
    figure, axes = subplots(2, len(outcome.found), height=6.8)
    looks = {FIRST_VARIANCE: (FIRST, "-"), ZEROTH_VARIANCE: (ZEROTH, "-"), SIZE: (REFERENCE, ":")}
    for (upper, lower), one in zip(axes.T, outcome.found, strict=True):
        for name, (colour, style) in looks.items():
            upper.plot(one.times, one.columns[name], style, color=colour, label=name)
        if np.isfinite(one.crossing[0]):
            upper.axvspan(*one.crossing[1:], color=FIRST, alpha=0.15, lw=0)
            upper.axvline(one.crossing[0], color=FIRST, lw=1, ls="--")
        upper.set(yscale="log", title=capitalised(one.title), xlabel="horizon, s")
        lengths = [one.times[n - 1] for n in one.windows]
        for i, style in enumerate(("o--", "s-")):
            label = "first order by windows" + ", with a value function" * i
            lower.plot(lengths, [x[0, i] for x in one.windows.values()], style, color=(FIRST, ONSET)[i], label=label)
            lower.plot(lengths, [x[1, i] or np.nan for x in one.windows.values()], ":", color=(FIRST, ONSET)[i])
        lower.axhline(one.zeroth_error, color=ZEROTH)
        lower.set(xscale="log", yscale="log", xlabel="length of the windows, s")
        for axis in (lower.xaxis, lower.yaxis):
            axis.set_minor_formatter(NullFormatter())
            plain(axis)
        for x, (alpha, _) in one.alphas.items():
            upper.annotate(
                f"{alpha:.1g}" if alpha >= 0.095 else "0",
                (one.times[x - 1], 0.02),
                xycoords=("data", "axes fraction"),
                fontsize=8,
                ha="center",
            )
    axes[0, 0].set_ylabel("variance of one rollout")
    axes[1, 0].set_ylabel("error over the gradient's size")
    legend_below(figure, axes[:, 0], 5)
    caption = (
        "Above, variance of the gradient of the cost at the horizon, summed over controls, and the squared gradient itself "
        "(dotted); dashed, where first order's passes zeroth order's, with its interval. At the foot, the mean α of α-order. "
        "Below, errors of 16 rollouts for the mean cost over the horizon, by windows; dotted, biases; blue, zeroth order."
    )
    return {"variance": (figure, "Variance against the horizon, and what windows do", caption)}
