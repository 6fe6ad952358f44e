"""From settings to numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.long_horizon.adaptive import adaptive
from experiments.long_horizon.estimates import reference_gradient, zeroth
from experiments.long_horizon.outcome import BEYOND_CHANCE, ZEROTH, Errors, Found, Outcome, Windows
from experiments.long_horizon.problems import Problem, problem
from experiments.long_horizon.settings import Settings, Sizes
from experiments.long_horizon.windows import cut
from experiments.parallel import in_threads
from experiments.workspace import Workspace
from mjxgrad.diagnostics import crossover, growth, root_mean_square_interval


class Rollouts(eqx.Module):
    """Rollouts under noise on the parameters, with what follows for the costs.

    Attributes:
        noise: on the parameters.
        states: at the end of every segment.
        tangents: their derivatives by the parameters; None where not asked for.
    """

    noise: Float[np.ndarray, "samples dim"]
    states: Float[np.ndarray, "samples times n"]
    tangents: Float[np.ndarray, "samples times n dim"] | None


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Measure every problem."""
    found, reference = {}, None
    for index, name in enumerate(settings.problems or settings.sizes.problems):
        one = problem(name, settings.sizes.num_times)
        workspace.check(one.scene)
        rng = np.random.default_rng([settings.seed, index])
        found[name] = _measure(settings, one, rng, workspace)
        if name == "double_pendulum":
            with workspace.stage("adaptive integration", "rollouts", 1):
                reference = adaptive(settings, one)
    return Outcome(settings, found, reference)


def _measure(settings: Settings, one: Problem, rng: np.random.Generator, workspace: Workspace) -> Found:
    sizes, dim = settings.sizes, len(one.params)
    whole, count, batch = sizes.num_times, sizes.num_repeats * sizes.num_samples, sizes.batch
    noise = one.stddev * rng.normal(size=(count, dim))
    with workspace.stage(f"{one.title}: reference", "rollouts", sizes.num_reference):
        # A pilot's slopes take out the linear part of the costs; fixed before the reference is drawn, they leave it unbiased.
        noises = [
            one.stddev * rng.normal(size=(n, dim)) for n in (max(sizes.num_reference // 8, batch), sizes.num_reference)
        ]
        pilot, many = (_run(one, each, whole, whole, None, batch)[0] for each in noises)
        pilot, many = (
            _chosen(each, np.flatnonzero(np.isfinite(each.states).all(axis=(1, 2)))) for each in (pilot, many)
        )
        reference, reference_error = reference_gradient(one.stddev, _costs(one, pilot), _costs(one, many))
    labels = [f"first order, {gradient}" for gradient in one.gradients]
    with workspace.stage(f"{one.title}: estimates", "gradients", len(one.gradients)) as advance_to:
        found = in_threads(lambda gradient: _run(one, noise, whole, whole, gradient, batch), one.gradients, advance_to)
    first = dict(zip(labels, found, strict=True))
    # What diverged is left out of all estimates alike, and the report says how much that was.
    is_finite = np.all([np.isfinite(slopes).all(axis=(1, 2)) for _, slopes in first.values()], axis=0)
    sizes = sizes.model_copy(update={"num_samples": int(is_finite.sum()) // sizes.num_repeats})
    kept = np.flatnonzero(is_finite)[: sizes.num_repeats * sizes.num_samples]
    noise = noise[kept]
    first = {label: (_chosen(rollouts, kept), slopes[kept]) for label, (rollouts, slopes) in first.items()}
    costs = _costs(one, next(iter(first.values()))[0])[1]
    samples = {label: slopes for label, (_, slopes) in first.items()} | {
        ZEROTH: zeroth(one.stddev, noise, costs, sizes)
    }
    estimators, squares = [], {}
    for label, each in samples.items():
        errors, squares[label] = _errors(settings, sizes, label, each, reference, reference_error)
        estimators.append(errors)
    times = one.interval * np.arange(1, whole + 1)
    crossovers = {
        label: crossover(times, squares[label], squares[ZEROTH], confidence=settings.confidence) for label in first
    }
    with workspace.stage(f"{one.title}: Jacobians", "rollouts", sizes.num_jacobians):
        params = one.params + jnp.asarray(noise[: sizes.num_jacobians])
        grown = growth(_jacobians(one, params, whole, one.gradients[-1]))
    log_largest = np.asarray(grown.log_largest)

    def windows(gradient: str) -> Windows:
        def again(length: int) -> np.ndarray:
            return np.asarray(_run(one, noise, length, whole, gradient, batch)[0].tangents)

        return cut(settings, sizes, one, again, many, first[f"first order, {gradient}"][0])

    with workspace.stage(f"{one.title}: windows", "gradients", len(one.gradients)) as advance_to:
        cuts = in_threads(windows, one.gradients, advance_to)
    return Found(
        title=one.title,
        times=times,
        costs=_costs(one, many)[1].mean(axis=0),
        reference=reference,
        reference_error=reference_error,
        estimators=estimators,
        crossovers=crossovers,
        log_largest=log_largest,
        exponents=np.median(np.asarray(grown.exponents(jnp.asarray(times))), axis=0),
        growth_rate=_rate(times, log_largest),
        variance_rate={each.label: _rate(times, np.log(each.variance)[None] / 2)[0] for each in estimators[:-1]},
        windows=dict(zip(labels, cuts, strict=True)),
        finite=float(is_finite.mean()),
    )


def _chosen(rollouts: Rollouts, rows: np.ndarray) -> Rollouts:
    return jax.tree.map(lambda x: x[rows], rollouts)


def _run(
    one: Problem, noise: np.ndarray, window: int, num_times: int, gradient: str | None, batch: int
) -> tuple[Rollouts, np.ndarray | None]:
    """Roll out in batches; with a gradient give the derivatives of the costs, too, one row per sample and time."""
    parts = []
    for start in range(0, len(noise), batch):
        params = one.params + jnp.asarray(np.resize(noise[start : start + batch], (batch, noise.shape[1])))
        size = min(batch, len(noise) - start)
        if gradient is None:
            part = (_states(one, params, num_times),)
        else:
            part = _tangents(one, params, jnp.full(batch, window), num_times, gradient)
        parts.append([np.asarray(each)[:size] for each in part])
    joined = [np.concatenate(each) for each in zip(*parts, strict=True)]
    if gradient is None:
        return Rollouts(noise, joined[0], None), None
    slopes = np.asarray(_cost_slopes(one, jnp.asarray(joined[0])))
    return Rollouts(noise, *joined), np.einsum("stn,stnd->std", slopes, joined[1])


@eqx.filter_jit
def _states(one: Problem, params: Float[Array, "samples dim"], num_times: int) -> Float[Array, "samples times n"]:
    return jax.vmap(lambda p: one.states(p, jnp.int32(num_times), num_times, "discrete"))(params)


@eqx.filter_jit
def _tangents(
    one: Problem, params: Float[Array, "samples dim"], windows: Int[Array, " samples"], num_times: int, gradient: str
) -> tuple[Float[Array, "samples times n"], Float[Array, "samples times n dim"]]:
    def differentiate(p: Float[Array, " dim"], window: Int[Array, ""]) -> tuple[Array, Array]:
        def along(direction: Float[Array, " dim"]) -> tuple[Array, Array]:
            return jax.jvp(lambda at: one.states(at, window, num_times, gradient), (p,), (direction,))

        return jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(p), dtype=p.dtype))

    return jax.vmap(differentiate)(params, windows)


@eqx.filter_jit
def _jacobians(
    one: Problem, params: Float[Array, "rollouts dim"], num_times: int, gradient: str
) -> Float[Array, "rollouts times n n"]:
    return jax.vmap(lambda p: one.jacobians(p, num_times, gradient))(params)


@eqx.filter_jit
def _cost_slopes(one: Problem, states: Float[Array, "samples times n"]) -> Float[Array, "samples times n"]:
    return jax.vmap(jax.vmap(jax.grad(one.cost)))(states)


def _costs(one: Problem, rollouts: Rollouts) -> tuple[np.ndarray, Float[np.ndarray, "samples times"]]:
    """Return noise and costs."""
    return rollouts.noise, np.asarray(jax.jit(jax.vmap(jax.vmap(one.cost)))(jnp.asarray(rollouts.states)))


def _errors(
    settings: Settings,
    sizes: Sizes,
    label: str,
    samples: np.ndarray,
    reference: np.ndarray,
    reference_error: np.ndarray,
) -> tuple[Errors, Float[np.ndarray, "repeats times"]]:
    """Return errors over the reference's largest size, and the squared errors of all repeats less the reference's own."""
    estimates = samples.reshape(sizes.num_repeats, sizes.num_samples, *samples.shape[1:]).mean(axis=1)
    scale = np.linalg.norm(reference, axis=1).max()
    off = (estimates - reference) / scale
    squares, known = (off**2).sum(axis=-1), ((reference_error / scale) ** 2).sum(axis=-1)
    mean = off.mean(axis=0)
    cross = ((2 * mean * reference_error / scale) ** 2 + 2 * (reference_error / scale) ** 4).sum(axis=-1)
    error, interval = root_mean_square_interval(
        squares.T, settings.confidence, reference_variance=known, cross_variance=cross
    )
    noise = (off.var(axis=0, ddof=1) / sizes.num_repeats).sum(axis=-1) + known
    return (
        Errors(
            label=label,
            error=error,
            interval=interval,
            bias=np.linalg.norm(mean, axis=-1),
            bias_noise=BEYOND_CHANCE * np.sqrt(noise),
            variance=samples.var(axis=0, ddof=1).sum(axis=-1),
        ),
        np.maximum(squares - known, 0.0),
    )


def _rate(times: np.ndarray, logs: np.ndarray) -> tuple[float, float]:
    """Return the slope over the second half of the time, and its standard error over rollouts."""
    half = len(times) // 2
    slopes = np.polyfit(times[half:], logs[:, half:].T, 1)[0]
    error = slopes.std(ddof=1) / np.sqrt(len(slopes)) if len(slopes) > 1 else 0.0
    return float(slopes.mean()), float(error)
