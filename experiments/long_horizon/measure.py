"""From settings to numbers."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import mjxgrad as mg
from experiments.long_horizon.problems import Problem, problem, vector
from experiments.long_horizon.settings import Settings, Sizes
from experiments.parallel import in_threads
from experiments.problems.comparison import root_mean_square_interval
from experiments.problems.growth import Growth, growth
from experiments.workspace import Workspace
from mjxgrad.diagnostics import Crossover, crossover

# Standard errors of a mean. Two would do for one in twenty of normal samples; derivatives along chaotic motions have tails so
# heavy that a few dozen repeats show too little of their spread.
_BEYOND_CHANCE = 3.0
# Of the features' own squares. Noisy parameters are few, so the states lie close to a surface, and across it a fit knows no
# slope; without a ridge its slopes there are arbitrary.
_RIDGE = 1e-2
# Of the integration with error control; and rad and rad/s, half width of differences: far above it, whatever it grows to.
_TOLERANCE, _AWAY = 1e-10, 1e-5

Reference = tuple[Float[np.ndarray, "kinds dim"], Float[np.ndarray, "kinds dim"]]
ZEROTH = "zeroth order"
CUT, VALUED = "cut", "with a value function"


@dataclass(frozen=True)
class Errors:
    """Errors of one way to estimate gradients, of some costs or by some windows, over the largest gradient's size.

    Root mean squared, with an interval; the bias of the mean of all estimates, and up to where it can be chance; the variance of
    one sample, summed over parameters, in the gradient's own units; squared errors by repeat, less the reference's own.
    """

    error: Float[np.ndarray, " kinds"]
    interval: Float[np.ndarray, "2 kinds"]
    bias: Float[np.ndarray, " kinds"]
    bias_noise: Float[np.ndarray, " kinds"]
    variance: Float[np.ndarray, " kinds"]
    squares: Float[np.ndarray, "repeats kinds"]


@dataclass(frozen=True)
class Windows:
    """Errors of the gradient of the mean cost over the whole horizon by windows of some lengths (s), the last the whole horizon.

    They are by derivative and by `CUT` or `VALUED`, over the gradient's size; `fit` is the share of the variance of the costs to
    come that the value function explains, in the median over times.
    """

    lengths: Float[np.ndarray, " windows"]
    errors: dict[tuple[str, str], Errors]
    zeroth: Errors
    fit: float


@dataclass(frozen=True)
class Found:
    """All that was measured on one problem, at the times at which the horizon may end (s).

    Errors are by estimator, zeroth order last, and of the gradient of the mean cost (m) at each time; crossovers are with zeroth.
    `log_largest` is of the product of Jacobians, by rollout; `exponents` are finite-time Lyapunov exponents, median over rollouts
    (1/s); `finite` is the share of rollouts with finite derivatives.
    """

    title: str
    times: Float[np.ndarray, " times"]
    costs: Float[np.ndarray, " times"]
    errors: dict[str, Errors]
    crossovers: dict[str, Crossover]
    log_largest: Float[np.ndarray, "rollouts times"]
    exponents: Float[np.ndarray, "times n"]
    windows: Windows
    finite: float


@dataclass(frozen=True)
class Adaptive:
    """The pendulum by error control, beside the steps, at some times (s).

    `apart` is the distance of the stepped state from the adaptive one, over the state's size; `log_largest` the logarithm of the
    largest singular value of the derivative by the start, by differences of adaptive rollouts, and `stepped` that of the steps.
    """

    times: Float[np.ndarray, " times"]
    apart: Float[np.ndarray, " times"]
    log_largest: Float[np.ndarray, " times"]
    stepped: Float[np.ndarray, " times"]
    num_steps: int


@dataclass(frozen=True)
class Outcome:
    """All that was measured: by problem, and the pendulum by error control if it is among them."""

    settings: Settings
    found: dict[str, Found]
    adaptive: Adaptive | None

    def rows(self) -> list[dict[str, Any]]:
        """One row per problem, estimator and horizon, for metrics.csv."""
        return [
            {
                "problem": name,
                "estimator": label,
                "horizon": float(time),
                "mean_cost": float(one.costs[i]),
                "relative_error": float(each.error[i]),
                "relative_error_low": float(each.interval[0, i]),
                "relative_error_high": float(each.interval[1, i]),
                "relative_bias": float(each.bias[i]),
                "variance": float(each.variance[i]),
                "median_log_largest_singular_value": float(np.median(one.log_largest[:, i])),
            }
            for name, one in self.found.items()
            for label, each in one.errors.items()
            for i, time in enumerate(one.times)
        ]


class Rollouts(eqx.Module):
    """Rollouts under noise on the parameters: states at the end of every segment, and what follows for the costs.

    Tangents are the states' derivatives by the parameters. Without a derivative they and the cost slopes are None.
    """

    noise: Float[np.ndarray, "samples dim"]
    states: Float[np.ndarray, "samples times n"]
    costs: Float[np.ndarray, "samples times"]
    cost_slopes: Float[np.ndarray, "samples times n"]
    tangents: Float[np.ndarray, "samples times n dim"]

    @property
    def slopes(self) -> Float[np.ndarray, "samples times dim"]:
        """Of the costs by the parameters."""
        return np.einsum("stn,stnd->std", self.cost_slopes, self.tangents)

    def at(self, rows: np.ndarray) -> "Rollouts":
        return jax.tree.map(lambda x: x[rows], self)


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every problem."""
    found, reference = {}, None
    for index, name in enumerate(settings.problems or settings.sizes.problems):
        one = problem(name, settings.sizes.num_times)
        workspace.check(one.scene, name=one.title)
        rng = np.random.default_rng([settings.seed, index])
        found[name] = workspace.once(name, lambda one=one, rng=rng: _measure(settings, one, rng, workspace))
        if name == "double_pendulum":
            with workspace.stage("adaptive integration", "rollouts", 1):
                reference = workspace.once("adaptive", lambda one=one: _adaptive(settings.sizes, one))
    return Outcome(settings, found, reference)


def _measure(settings: Settings, one: Problem, rng: np.random.Generator, workspace: Workspace) -> Found:
    sizes, dim = settings.sizes, len(one.params)
    run = functools.partial(_run, one, batch=sizes.batch)
    noise = one.stddev * rng.normal(size=(sizes.num_repeats * sizes.num_samples, dim))
    with workspace.stage(f"{one.title}: reference", "rollouts", sizes.num_reference):
        # A pilot's slopes take out the linear part of the costs; fixed before the reference is drawn, they leave it unbiased.
        counts = max(sizes.num_reference // 8, sizes.batch), sizes.num_reference
        every = [run(one.stddev * rng.normal(size=(count, dim))) for count in counts]
        pilot, many = (each.at(np.flatnonzero(np.isfinite(each.states).all(axis=(1, 2)))) for each in every)
        reference = reference_gradient(one.stddev, (pilot.noise, pilot.costs), (many.noise, many.costs))
    with workspace.stage(f"{one.title}: estimates", "gradients", len(one.gradients)) as advance_to:
        every = in_threads(lambda gradient: run(noise, gradient), one.gradients, advance_to)
    # What diverged is left out of all estimates alike, and the report says how much that was.
    is_finite = np.all([np.isfinite(each.slopes).all(axis=(1, 2)) for each in every], axis=0)
    num_samples = int(is_finite.sum()) // sizes.num_repeats
    kept = np.flatnonzero(is_finite)[: sizes.num_repeats * num_samples]
    every = [each.at(kept) for each in every]
    errors_of = functools.partial(_errors, num_repeats=sizes.num_repeats, confidence=settings.confidence)
    labels = [f"first order, {gradient}" for gradient in one.gradients]
    errors = {label: errors_of(own.slopes, reference) for label, own in zip(labels, every, strict=True)}
    last = errors_of(zeroth(one.stddev, every[0].noise, every[0].costs, num_samples), reference)
    times = one.interval * np.arange(1, one.num_times + 1)
    crossovers = {
        label: crossover(times, each.squares, last.squares, confidence=settings.confidence)
        for label, each in errors.items()
    }
    with workspace.stage(f"{one.title}: Jacobians", "rollouts", sizes.num_jacobians):
        grown = _growth(one, one.params + jnp.asarray(every[0].noise[: sizes.num_jacobians]), one.gradients[-1])
    with workspace.stage(f"{one.title}: windows", "gradients", len(one.gradients)) as advance_to:
        found = in_threads(lambda at: _cut(run, one, many, every[at], one.gradients[at]), range(len(every)), advance_to)
    return Found(
        title=one.title,
        times=times,
        costs=many.costs.mean(axis=0),
        errors=errors | {ZEROTH: last},
        crossovers=crossovers,
        log_largest=np.asarray(grown.log_largest),
        exponents=np.median(np.asarray(grown.exponents(jnp.asarray(times))), axis=0),
        windows=_windows(one, many, every[0], dict(zip(errors, found, strict=True)), num_samples, errors_of),
        finite=float(is_finite.mean()),
    )


def _windows(
    one: Problem,
    many: Rollouts,
    own: Rollouts,
    cuts: dict[str, Any],
    num_samples: int,
    errors_of: Callable[..., Errors],
) -> Windows:
    # The costs' mean over the whole horizon; an eighth of the rollouts is the pilot.
    count, total = len(many.costs) // 8, many.costs.mean(axis=1, keepdims=True)
    whole = reference_gradient(one.stddev, (many.noise[:count], total[:count]), (many.noise[count:], total[count:]))
    return Windows(
        lengths=one.interval * np.array(_lengths(one)),
        errors={(label, kind): errors_of(x, whole) for label, (cut, _) in cuts.items() for kind, x in cut.items()},
        zeroth=errors_of(zeroth(one.stddev, own.noise, own.costs.mean(axis=1, keepdims=True), num_samples), whole),
        fit=next(iter(cuts.values()))[1],
    )


def zeroth(
    stddev: float, noise: Float[np.ndarray, "samples dim"], costs: Float[np.ndarray, "samples kinds"], num_samples: int
) -> Float[np.ndarray, "samples kinds dim"]:
    """Give samples of the zeroth-order gradient, with the mean of each estimate's other costs as baseline."""
    groups = costs.reshape(-1, num_samples, costs.shape[1])
    others = (groups.sum(axis=1, keepdims=True) - groups) / (num_samples - 1)
    return ((groups - others).reshape(costs.shape))[:, :, None] * (noise / stddev**2)[:, None]


def reference_gradient(
    stddev: float, pilot: tuple[np.ndarray, np.ndarray], many: tuple[np.ndarray, np.ndarray]
) -> Reference:
    """Give the gradient of mean costs from noise and costs alone, and its standard error; the pilot's slopes are taken out."""
    noise, costs = pilot
    slopes = np.linalg.lstsq(noise, costs - costs.mean(axis=0), rcond=None)[0]
    rest = many[1] - costs.mean(axis=0) - many[0] @ slopes
    samples = rest[:, :, None] * (many[0] / stddev**2)[:, None]
    return slopes.T + samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def _errors(
    samples: Float[np.ndarray, "samples kinds dim"], reference: Reference, *, num_repeats: int, confidence: float
) -> Errors:
    scale = np.linalg.norm(reference[0], axis=1).max()
    known = (reference[1] / scale) ** 2
    estimates = samples.reshape(num_repeats, -1, *samples.shape[1:]).mean(axis=1)
    off = (estimates - reference[0]) / scale
    squares, mean = (off**2).sum(axis=-1), off.mean(axis=0)
    error, interval = root_mean_square_interval(
        squares.T,
        confidence,
        reference_variance=known.sum(axis=-1),
        cross_variance=(4 * mean**2 * known + 2 * known**2).sum(axis=-1),
    )
    return Errors(
        error=error,
        interval=interval,
        bias=np.linalg.norm(mean, axis=-1),
        bias_noise=_BEYOND_CHANCE * np.sqrt((off.var(axis=0, ddof=1) / num_repeats + known).sum(axis=-1)),
        variance=samples.var(axis=0, ddof=1).sum(axis=-1),
        squares=np.maximum(squares - known.sum(axis=-1), 0.0),
    )


def _run(
    one: Problem, noise: np.ndarray, gradient: str | None = None, window: int | None = None, *, batch: int
) -> Rollouts:
    """Roll out in batches, so that one compilation serves all; with a gradient also what follows for derivatives."""
    parts = []
    for start in range(0, len(noise), batch):
        some = noise[start : start + batch]
        params = one.params + jnp.asarray(np.resize(some, (batch, noise.shape[1])))
        found = _simulated(one, params, jnp.int32(window or one.num_times), gradient)
        parts.append(jax.tree.map(np.asarray, found))
    return Rollouts(noise, *jax.tree.map(lambda *each: np.concatenate(each)[: len(noise)], *parts))


@eqx.filter_jit
def _simulated(one: Problem, params: Float[Array, "samples dim"], window: Int[Array, ""], gradient: str | None):
    """Return what `Rollouts` has besides the noise."""

    def states(p: Float[Array, " dim"]) -> Float[Array, "times n"]:
        return one.states(p, window, gradient or "discrete")

    def differentiate(p: Float[Array, " dim"]) -> tuple[Array, Array]:
        return jax.vmap(lambda d: jax.jvp(states, (p,), (d,)), out_axes=(None, -1))(jnp.eye(len(p), dtype=p.dtype))

    costs = jax.vmap(jax.vmap(one.cost))
    if gradient is None:
        found = jax.vmap(states)(params)
        return found, costs(found), None, None
    found, tangents = jax.vmap(differentiate)(params)
    return found, costs(found), jax.vmap(jax.vmap(jax.grad(one.cost)))(found), tangents


@eqx.filter_jit
def _growth(one: Problem, params: Float[Array, "rollouts dim"], gradient: str) -> Growth:
    return growth(jax.vmap(lambda p: one.jacobians(p, gradient))(params))


def _lengths(one: Problem) -> tuple[int, ...]:
    return (*(length for length in (1, 2, 4, 8, 16, 32) if length < one.num_times), one.num_times)


def _cut(
    run, one: Problem, many: Rollouts, own: Rollouts, gradient: str
) -> tuple[dict[str, Float[np.ndarray, "samples windows dim"]], float]:
    """Give samples of the gradient of the mean cost over the whole horizon from windows of every length.

    A window charges the costs in it, and at its end the fitted value of the costs to come; the next one starts from the same
    state without its derivative, as in SHAC (Xu et al., arXiv:2204.07137). The share that the value explains goes with them.
    """
    value_slopes, fit = _value_slopes(one, many, own.states)
    plain, valued = [], []
    for length in _lengths(one):
        tangents = run(own.noise, gradient, length).tangents
        ends = np.arange(length - 1, one.num_times - 1, length)
        plain.append(np.einsum("stn,stnd->sd", own.cost_slopes, tangents) / one.num_times)
        later = np.einsum("stn,stnd->sd", value_slopes[:, ends], tangents[:, ends]) / one.num_times
        valued.append(plain[-1] + later)
    return {CUT: np.stack(plain, axis=1), VALUED: np.stack(valued, axis=1)}, fit


def _value_slopes(one: Problem, many: Rollouts, at: np.ndarray) -> tuple[Float[np.ndarray, "samples times n"], float]:
    """Fit the sum of the costs to come by a quadratic in what is observed, time by time, and differentiate it elsewhere."""

    def features(x: Float[Array, " n"], centre: Array, size: Array) -> Float[Array, " features"]:
        z = (one.observe(x) - centre) / size
        rows, columns = np.triu_indices(z.shape[0])
        return jnp.concatenate([jnp.ones(1), z, z[rows] * z[columns]])

    every = jax.jit(jax.vmap(features, in_axes=(0, None, None)))
    slopes = jax.jit(
        jax.vmap(jax.grad(lambda x, centre, size, w: features(x, centre, size) @ w), in_axes=(0, None, None, None))
    )
    later = many.costs[:, ::-1].cumsum(axis=1)[:, ::-1] - many.costs
    # Less its mean, which a ridge would pull towards zero with the rest, and which has no slope.
    later = later - later.mean(axis=0)
    found, fits = np.zeros_like(at), []
    for time in range(one.num_times - 1):
        states = jnp.asarray(many.states[:, time])
        seen = np.asarray(jax.vmap(one.observe)(states))
        centre, size = seen.mean(axis=0), np.maximum(seen.std(axis=0), 1e-9)
        basis = np.asarray(every(states, centre, size))
        gram = basis.T @ basis
        ridge = _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
        weights = np.linalg.solve(gram + ridge, basis.T @ later[:, time])
        rest = later[:, time] - basis @ weights
        fits.append(1 - rest.var() / max(later[:, time].var(), np.finfo(float).tiny))
        found[:, time] = slopes(jnp.asarray(at[:, time]), centre, size, jnp.asarray(weights))
    return found, float(np.median(fits))


def _adaptive(sizes: Sizes, pendulum: Problem) -> Adaptive:
    """Integrate the pendulum without noise, and its neighbours, by error control: how far its steps are the motion."""
    import diffrax

    every = sizes.num_times // (2 * sizes.num_adaptive)
    times = pendulum.interval * every * np.arange(1, sizes.num_adaptive + 1)
    moments = jnp.concatenate([jnp.zeros(1), jnp.asarray(times)])
    around = jnp.concatenate([jnp.zeros((1, 4)), _AWAY * jnp.eye(4), -_AWAY * jnp.eye(4)])

    @jax.jit
    @jax.vmap
    def integrate(shift: jax.Array):
        start = vector(pendulum.start) + shift
        state = mg.initial_state(pendulum.scene, start[:2], start[2:])
        found = mg.integration.adaptive_rollout(
            pendulum.scene, state, moments, tolerance=_TOLERANCE, solver=diffrax.Dopri8()
        )
        return jnp.concatenate([found.qpos, found.qvel], axis=1)[1:], found.num_steps

    states, num_steps = (np.asarray(each) for each in integrate(around))
    slopes = (states[1:5] - states[5:]) / (2 * _AWAY)

    @jax.jit
    def stepped(params: jax.Array):
        at = pendulum.states(params, jnp.int32(sizes.num_times), "discrete")
        return at, growth(pendulum.jacobians(params, "discrete")).log_largest

    at, log_largest = (np.asarray(each)[every - 1 :: every][: len(times)] for each in stepped(pendulum.params))
    return Adaptive(
        times=times,
        apart=np.linalg.norm(at - states[0], axis=1) / np.linalg.norm(states[0], axis=1),
        log_largest=np.log(np.linalg.norm(np.moveaxis(slopes, 0, 2), ord=2, axis=(1, 2))),
        stepped=log_largest,
        num_steps=int(num_steps[0]),
    )
