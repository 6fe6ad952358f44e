r"""Bias and variance of first, zeroth and α-order gradients, against contact softness.

The bias is relative to the gradient of the smoothed objective, computed without the estimators under test.
For noise on a single parameter this gradient is an integral over a line,

$$F'(\theta) = \int (f(x) - f(\theta)) \frac{x - \theta}{\sigma^2}
   \varphi\!\left(\frac{x - \theta}{\sigma}\right) \frac{dx}{\sigma},$$

so one sweep of $f$ serves every $\theta$. The line is cut into equal cells and $f$ evaluated at a random place in each
(stratified sampling). This is unbiased for any $f$, including jumps and the fine saw teeth of simulated impacts. The
error falls as 1/cells at a jump and faster elsewhere. Quadrature on regular points could not know its error at jumps.
"""

import contextlib
import dataclasses
import functools
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray, PyTree, Shaped

from mjxgrad._arrays import function, one_key, whole
from mjxgrad._interrupts import finished
from mjxgrad._programs import compile_once
from mjxgrad._text import Printed, aligned, format_number
from mjxgrad.contact import Softness
from mjxgrad.diagnostics.statistics import bootstrap_variance_interval, checked, mean_interval
from mjxgrad.estimators.estimate import GradientEstimate
from mjxgrad.estimators.first_and_zeroth import both_results, both_summary
from mjxgrad.estimators.mixture import both_parts, weigh
from mjxgrad.estimators.moments import Moments
from mjxgrad.estimators.rules import LeastRisk
from mjxgrad.estimators.samples import DEFAULT_CHUNK_SIZE, Plan, Samples, sample
from mjxgrad.objective import Differentiated, Objective, ParameterNoise
from mjxgrad.objective.base import unchanged
from mjxgrad.report import require
from mjxgrad.scene import SceneWarning

# The Gaussian weight beyond six standard deviations is below 1e-7 of its peak.
REACH = 6.0
# Rollouts of one α-order estimate, from which it also chooses α.
BATCH = 16
# Rounds in which all softnesses get their samples, so that an interruption leaves some of each; and fewest samples of one.
_ROUNDS, _FEWEST = 8, 32
# XLA keeps 1.3 of two cores busy with one such program.
_WORKERS = 2
# In words, with colours and markers that colour-blind readers can tell apart (Okabe and Ito 2008).
ESTIMATES = {"first": "first order", "zeroth": "zeroth order", "alpha_order": "α-order"}
_HIDDEN = 30.0  # times the usual gradient
_EXPLODES = "explodes"
_BEYOND = 1e12  # times the largest gradient, from which numbers tell nothing
_LOOKS = {"first": ("#d55e00", "o", "-"), "zeroth": ("#0072b2", "s", "--"), "alpha_order": ("#009e73", "D", ":")}
_NORMAL = 10**6  # samples, of which Student's t distribution is normal
_TOO_STIFF = "without gaining energy"  # part of the warning about a contact that the time step cannot follow


class Landscape(eqx.Module):
    """A cost along one parameter, sampled at one random point in each of many equal cells.

    Attributes:
        points: the sampled parameter values, ascending.
        costs: the cost at each point.
        cell: the length of a cell.
    """

    points: Float[Array, " cells"]
    costs: Float[Array, "*batch cells"]
    cell: Float[Array, ""]

    def smoothed_gradient(
        self, params: Float[Array, ""], stddev: Float[Array, ""], centre: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the gradient of the smoothed cost, and its standard error.

        The point `params` must lie at least `REACH` standard deviations of the noise inside the landscape. The baseline
        `centre`, such as the cost at `params`, must not be one of these costs. Both results are NaN if a cost with weight is
        not finite.
        """
        offset = (self.points - params) / stddev
        weight = offset / stddev * jax.scipy.stats.norm.pdf(offset) / stddev
        # Outside the reach a cost may be anything, also not finite.
        terms = jnp.where(jnp.abs(offset) <= REACH, (self.costs - centre) * weight, 0) * self.cell
        # Neighbouring cells differ by their variances and their means, so this errs on the large side. Two points per cell
        # would be unbiased, but mostly miss the only cell that matters: the one with the jump.
        variance = (jnp.diff(terms) ** 2).sum(axis=-1) / 2
        return terms.sum(axis=-1), jnp.sqrt(variance)


def cell_points(
    key: PRNGKeyArray, low: Float[Array, ""], high: Float[Array, ""], num_cells: int
) -> tuple[Float[Array, " cells"], Float[Array, ""]]:
    """Return one random point in each of the equal cells of a line, ascending, and the length of a cell."""
    cell = (high - low) / num_cells
    return low + cell * (jnp.arange(num_cells) + jax.random.uniform(key, (num_cells,), cell.dtype)), cell


def map_in_chunks(function: Callable, points: PyTree, chunk_size: int) -> PyTree:
    """Apply a function under `jax.vmap` to points with a leading axis, one chunk at a time."""
    count = jax.tree.leaves(points)[0].shape[0]
    num_chunks = -(-count // chunk_size)
    size = -(-count // num_chunks)
    # The last point fills up the last chunk: `jax.lax.map` would compile the function a second time for a remainder.
    indices = jnp.minimum(jnp.arange(num_chunks * size), count - 1)
    filled = jax.tree.map(lambda leaf: leaf[indices], points)
    return jax.tree.map(lambda leaf: leaf[:count], jax.lax.map(function, filled, batch_size=size))


class BiasVariance(eqx.Module, Printed):
    """The measurements of `bias_variance`; the leading axes are `softness` × `points`.

    Attributes:
        softness: the contact softnesses, stacked.
        params: the points.
        first: the first-order estimates.
        zeroth: the zeroth-order estimates, from the same rollouts.
        alpha_order: the mean of the α-order estimates, each from one batch of 16 of the same rollouts, with
            their variance per rollout and their mean α. None for fewer than two batches, random starts, or an objective whose
            noise is unknown.
        cost: the cost without noise.
        reference: the gradient of the smoothed cost, from separate rollouts: by a landscape, or the mean of many by an
            estimator that stays unbiased with wrong derivatives.
        reference_error: standard error of the reference.
        variance_intervals: lower and upper end of each estimate's variance per rollout, by percentile bootstrap.
        landscape: the cost along the parameter at every softness; None unless there is a single parameter with noise.
        warnings: the warnings of the scene at each softness, such as a time step that is too long; often empty.
        confidence: coverage of every interval.
        share: share of the rollouts that were made; below 1 after an interruption.
        seconds: duration of one differentiated rollout, in s.
    """

    softness: PyTree
    params: Float[Array, "points dim"]
    first: GradientEstimate
    zeroth: GradientEstimate
    alpha_order: GradientEstimate | None
    cost: Float[Array, "softness points"]
    reference: Float[Array, "softness points dim"]
    reference_error: Float[Array, "softness points dim"]
    variance_intervals: dict[str, Float[np.ndarray, "2 softness points"]]
    landscape: Landscape | None
    warnings: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    confidence: float = eqx.field(static=True)
    share: float = eqx.field(static=True)
    seconds: float = eqx.field(static=True)

    @property
    def bias(self) -> Float[Array, "softness points dim"]:
        """First order less reference."""
        return self.first.value - self.reference

    def interval(self, name: str) -> Float[np.ndarray, "2 softness points dim"]:
        """Return Student's t interval of the mean `first`, `zeroth` or `alpha_order`; those of biases are in `table`."""
        one = getattr(self, name)
        return mean_interval(one.value, one.standard_error, one.num_finite[..., None], self.confidence)

    @property
    def knob(self) -> tuple[str, Float[np.ndarray, " softness"]]:
        """Name and values of the swept quantity: the stiffness, a plain array, or else the numbers 1, 2, ... of the list."""
        given = self.softness.stiffness if isinstance(self.softness, Softness) else self.softness
        if eqx.is_array(given) and given.ndim == 1:  # pyright: ignore[reportOptionalMemberAccess]
            return "softness" if given is self.softness else "stiffness, 1/s²", np.asarray(given, float)
        return "number", np.arange(1.0, len(self.cost) + 1)

    def table(self) -> dict[str, Shaped[np.ndarray, "softness points"]]:
        """Return `truth` and each estimate's bias and variance, such as `first_bias`, with ends `_low` and `_high`.

        For several parameters these are norms, with conservative intervals (see `BiasConstrained`). `_is_biased` says where a
        bias is significant over the whole table.
        """
        is_one = self.params.shape[1] == 1
        found: dict[str, Any] = {"finite_share": self.first.finite_fraction}
        levels = self.confidence, 1 - (1 - self.confidence) / self.cost.size

        def add(name: str, value: ArrayLike, error: ArrayLike, count: ArrayLike) -> None:
            size = np.asarray(value)[..., 0] if is_one else np.linalg.norm(value, axis=-1)
            half, reach = (mean_interval(0.0, np.linalg.norm(error, axis=-1), count, level)[1] for level in levels)
            low = size - half if is_one else np.maximum(size - half, 0)
            found.update({name: size, f"{name}_low": low, f"{name}_high": size + half})
            found[name.removesuffix("_bias") + "_is_biased"] = abs(size) > reach

        # The reference averages so many cells or samples that its t distribution is normal.
        add("truth", self.reference, self.reference_error, _NORMAL)
        for name in ESTIMATES:
            if (one := getattr(self, name)) is not None:
                error = np.hypot(one.standard_error, self.reference_error)  # independent: of separate rollouts
                add(f"{name}_bias", one.value - self.reference, error, one.num_finite)
                low, high = self.variance_intervals[name]
                found |= {f"{name}_variance": one.variance, f"{name}_variance_low": low, f"{name}_variance_high": high}
                found["alpha"] = one.alpha
        return {name: np.asarray(value) for name, value in found.items() if name != "truth_is_biased"}

    def rows(self, labels: Sequence[str] | None = None) -> list[list[str]]:
        """Return the table as text, header first; labels name the softnesses in place of their numbers."""
        (title, swept), table = self.knob, self.table()
        names, points = [name for name in ESTIMATES if f"{name}_bias" in table], np.asarray(self.params)
        has_alpha, is_many = "alpha_order" in names, len(points) > 1
        first, *rest = (ESTIMATES[name].removesuffix(" order") for name in names)
        heads = [title, *["at"] * is_many, "truth", f"bias: {first}", *rest, f"variance: {first}", *rest]
        lines = [[*heads, *["α"] * has_alpha]]
        beyond = _beyond(table)
        for i, j in np.ndindex(self.cost.shape):
            one = {name: value[i, j] for name, value in table.items()}
            truth, *biases = (_with_half(one, x, beyond) for x in ("truth", *(f"{name}_bias" for name in names)))
            biases = [text + " *" * bool(one[f"{x}_is_biased"]) for text, x in zip(biases, names, strict=True)]
            label = (labels[i] if labels else format_number(swept[i])) + " !" * bool(self.too_stiff[i])  # pyright: ignore[reportArgumentType, reportOperatorIssue]
            variances = [f"{x:.2g}" if not x > beyond**2 else _EXPLODES for x in (one[f"{y}_variance"] for y in names)]
            at = [" ".join(f"{x:.3g}" for x in points[j]) if points.shape[1] < 4 else str(j)] * is_many
            lines.append([label, *at, truth, *biases, *variances, *[f"{one['alpha']:.2f}"] * has_alpha])
        return lines

    def notes(self) -> list[str]:
        """Return sentences that explain the table, and a warning where the time step is too long."""
        what = "gradient" if self.params.shape[1] == 1 else "norm of the gradient"
        told = (
            f"Truth: {what} of the cost under noise, from separate rollouts; ± is half a {self.confidence:.0%} interval. "
            "Variance: of one rollout. *: a bias that is significant over the whole table. α: the weight of first order in "
            "batches of 16 rollouts; at 0 its derivatives still lower the variance, without bias."
        )
        return [told, *[f"!: the time step is too long for it. {text}." for text in self.too_stiff if text][:1]]

    @property
    def too_stiff(self) -> list[str]:
        return [next((text for text in told if _TOO_STIFF in text), "") for told in self.warnings]

    def summary(self, labels: Sequence[str] | None = None) -> str:
        """Write the table for a terminal; labels name the softnesses in place of their numbers."""
        return "\n".join([*aligned(self.rows(labels), str.ljust), "", *self.notes()])

    __str__ = summary

    def plot(self, only: Literal["bias", "variance"] | None = None) -> Any:
        """Draw bias and variance against softness by matplotlib, one column per point, and return the figure."""
        require()
        import matplotlib.pyplot as plt

        table, (title, swept), points = self.table(), self.knob, len(self.params)
        shown = ("bias", "variance") if only is None else (only,)
        settings = {"squeeze": False, "sharex": True, "sharey": "row", "layout": "constrained"}
        size = (max(4.6, 3.2 * points), 2.7 * len(shown) + 0.5 * (only is not None))
        figure, axes = plt.subplots(len(shown), points, figsize=size, **settings)
        for row, what in zip(axes, shown, strict=True):
            beyond = _beyond(table) if what == "bias" else _beyond(table) ** 2
            for j, axis in enumerate(row):
                for name, (colour, marker, line) in _LOOKS.items():
                    if f"{name}_{what}" in table:
                        ends = np.array([table[f"{name}_{what}{end}"][:, j] for end in ("", "_low", "_high")])
                        y, low, high = np.where((np.abs(ends) < beyond).all(axis=0), ends, np.nan)
                        look = {"color": colour, "marker": marker, "ls": line, "label": ESTIMATES[name]}
                        axis.errorbar(swept, y, np.maximum([y - low, high - y], 0), ms=4, lw=1, capsize=2, **look)
                is_log = what == "variance" and any((line.get_ydata() > 0).any() for line in axis.lines)
                axis.set(yscale="log" if is_log else "linear")
                axis.set(xscale="log" if title[0] == "s" and (swept > 0).all() else "linear")
                if what == "bias":
                    axis.axhline(0, color="grey", lw=0.8)
                    axis.plot(swept, table["truth"][:, j], color="grey", ls="-.", label="the gradient itself")
            row[0].set_ylabel("bias of the gradient (cost per unit)" if what == "bias" else "variance of one rollout")
        # Where contact is so stiff that derivatives explode, a linear axis would hide all other biases.
        usual = float(np.median(np.abs(table["truth"])))
        if shown[0] == "bias" and max(map(abs, axes[0, 0].get_ylim())) > _HIDDEN * usual > 0:
            axes[0, 0].set_yscale("symlog", linthresh=10 ** (np.floor(np.log10(usual)) - 1))
        for axis in axes[-1]:
            axis.set_xlabel(title)
        axes[0, 0].legend(fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
        return figure


def _beyond(table: Mapping[str, np.ndarray]) -> float:
    """Return the size from which a gradient has exploded."""
    return _BEYOND * (np.nanmax(np.abs(table["truth"]), initial=0.0).item() or 1.0)


def _with_half(numbers: Mapping[str, Any], name: str, beyond: float) -> str:
    """Return a number with half its interval as text."""
    value, low, high = (numbers[f"{name}{end}"] for end in ("", "_low", "_high"))
    return _EXPLODES if abs(value) > beyond else f"{value:.3g} ± {(high - low) / 2:.2g}"


def bias_variance(
    objective_of_softness: Callable[[PyTree], Objective],
    params: Float[ArrayLike, "..."],
    key: PRNGKeyArray,
    *,
    softness: PyTree,
    num_samples: int = 256,
    num_reference: int = 2048,
    reference: Callable[[PyTree, PRNGKeyArray, int], tuple[ArrayLike, ArrayLike]] | None = None,
    confidence: float = 0.95,
    compiler_options: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BiasVariance:
    r"""Measure bias and variance of first, zeroth and α-order gradient estimates at every softness and point.

    All softnesses share the same noise, which makes differences between them visible. A program is compiled once, at the first
    softness. Each softness gets an eighth of its rollouts in turn, so that Ctrl-C ends with some of all, and waits for none.
    Samples are kept for the bootstrap: memory grows with points × `num_samples` × dim.

    Args:
        objective_of_softness: function from one softness to the objective; traceable.
        params: points to measure at, one per row, in the parameters' units.
        key: consumed here.
        softness: any pytree whose leaves have a leading axis, such as a `Softness` of arrays.
        num_samples: differentiated rollouts per softness and point. At least 2.
        num_reference: rollouts for the reference. They count per softness for a single parameter with noise (one landscape
            serves all points), otherwise per softness and point. At least 4.
        reference: function from one softness, a key and this number to the gradient at all points and its standard error, from
            rollouts of its own; None takes more of the rollouts that are differentiated.
        confidence: coverage of the intervals.
        compiler_options: options for XLA.
        progress: called after every part of the work with the number done and the total.

    Raises:
        ValueError: if `params` is not a matrix, `softness` has no or unequal leading axes, or a number is out of range.

    References:
        Suh, Simchowitz, Zhang, Tedrake. ICML 2022, arXiv:2202.00817, section 3 (bias), figure 4 (variance against stiffness).
    """
    if jnp.ndim(params) != 2:
        raise ValueError(
            f"params must have shape (points, dim), got {jnp.shape(params)}; for one parameter params[:, None]"
        )
    params = jnp.asarray(params)
    checked(confidence)  # before hours of work
    whole("num_reference", num_reference, 4)
    function("progress", progress, "done", "total")
    one_key(key)
    stacked = jax.tree.map(jnp.asarray, softness)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(stacked)}
    if len(lengths) != 1 or () in lengths or (0,) in lengths:
        told = f"got lengths {sorted(lengths)}; give arrays, not lists"
        raise ValueError(f"softness must have the same leading axis in every leaf, {told}")
    ((count,),) = lengths
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(count)]
    objective, told = _warned(objective_of_softness, each)
    # Derivatives by the noise where it is known: α-order needs them, and those by the parameters follow.
    knows_noise = type(objective).differentiate is not Objective.differentiate and not objective.has_circumstances
    wanted = {"with_gradient": True, "with_score": True, "by_noise": knows_noise}
    is_line = isinstance(objective, ParameterNoise) and params.shape[1] == 1 and reference is None
    plan = Plan(num_samples, with_zero_noise=not is_line, **wanted)
    units = _rounds(plan)

    def program(part: Callable, *rest: Any) -> Any:
        """Return a part of the measurement at one softness, ready to be compiled."""
        measure = lambda one, at, *rest: part(objective_of_softness(one).sized_for(at[0]), at, *rest)  # noqa: E731
        return jax.jit(measure).lower(each[0], params, key, *rest)

    lowered, line = program(functools.partial(_sampled, plan=plan), units[0]), None
    drawn = compile_once(lowered, compiler_options)
    if is_line:
        line = compile_once(program(functools.partial(_by_landscape, num_reference=num_reference)), compiler_options)
    has_alpha = knows_noise and num_samples >= 2 * BATCH
    longer = lambda x: jax.ShapeDtypeStruct((x.shape[0], len(units) * x.shape[1], *x.shape[2:]), x.dtype)  # noqa: E731
    finish = jax.jit(functools.partial(_summary, plan=plan, has_alpha=has_alpha))
    summarise = compile_once(finish.lower(jax.tree.map(longer, lowered.out_info)))
    others = range(1, 1 + -(-num_reference // num_samples))
    # C MuJoCo is called back. Two programs that wait for it at once leave JAX no thread on two cores to hand it their numbers.
    num_workers = 1 if "callback" in lowered.as_text() else _WORKERS
    alone, is_double = threading.Lock(), jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]

    def work(job: tuple[int, int]) -> tuple[Samples, Any, float]:
        (number, i), began, found = job, time.perf_counter(), None
        with jax.enable_x64(is_double):  # a thread does not see settings made by `with`
            samples = jax.block_until_ready(drawn(each[i], params, jax.random.split(key)[0], units[number]))
            spent = time.perf_counter() - began
            if reference is not None:
                with alone:
                    found = reference(each[i], jax.random.fold_in(key, number), -(-num_reference // len(units)))
            elif line is None:
                more = [drawn(each[i], params, jax.random.fold_in(key, k), units[number]) for k in others]
                found = _unbiased(jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *more), plan)
            elif number == 0:
                found = line(each[i], params, jax.random.split(key)[1])
        return samples, jax.block_until_ready(found), spent

    done: list[list[tuple[Samples, Any, float]]] = [[] for _ in each]
    jobs = [(number, i) for number in range(len(units)) for i in range(count)]
    pool = ThreadPoolExecutor(num_workers)
    # An interruption waits for no job that has begun.
    with contextlib.suppress(KeyboardInterrupt):
        try:
            for number, found in enumerate(pool.map(work, jobs)):
                done[jobs[number][1]].append(found)
                if progress is not None:
                    progress(number + 1, len(jobs))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    if not done[0]:
        raise KeyboardInterrupt

    def summed() -> BiasVariance:
        rows = []
        for pieces in filter(None, done):
            empty = [jax.tree.map(jnp.zeros_like, pieces[0][0])] * (len(units) - len(pieces))
            samples = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *(one for one, *_ in pieces), *empty)
            measured, terms = summarise(samples)
            measured["landscape"] = None
            if line is not None:
                measured |= pieces[0][1]
            else:
                values, errors = (jnp.stack([jnp.asarray(one[1][k]) for one in pieces]) for k in (0, 1))
                measured["reference"] = values.mean(axis=0)
                measured["reference_error"] = jnp.sqrt((errors**2).sum(axis=0)) / len(pieces)
            ends = {
                k: [bootstrap_variance_interval(x, confidence) for x in np.asarray(one)] for k, one in terms.items()
            }
            rows.append((measured, ends))
        # The first of each kind also begins with memory.
        spent = [one[2] for pieces in done for one in (pieces[1:] or pieces)]
        swept = jax.tree.map(lambda leaf: leaf[: len(rows)], stacked)
        found = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[row[0] for row in rows])
        return BiasVariance(
            **found,
            softness=swept,
            params=params,
            variance_intervals={k: np.moveaxis(np.array([ends[k] for _, ends in rows]), -1, 0) for k in rows[0][1]},
            warnings=told[: len(rows)],
            confidence=confidence,
            share=sum(map(len, done)) / len(jobs),
            seconds=float(np.median(spent)) / units[0].size / len(params) / num_workers,
        )

    return finished(summed)


def _rounds(plan: Plan) -> Int[np.ndarray, "rounds chunks units"]:
    """Return the units of each round, in chunks: the one without noise first, and in the end some that do not count."""
    total = plan.num_units + plan.with_zero_noise
    rounds = min(max(_ROUNDS, total // DEFAULT_CHUNK_SIZE), max(1, plan.num_samples // _FEWEST))
    num_chunks = -(-total // (rounds * DEFAULT_CHUNK_SIZE))
    size = -(-total // (rounds * num_chunks))
    order = [plan.num_units] * plan.with_zero_noise + list(range(plan.num_units))
    order += [plan.num_units + 1] * (rounds * num_chunks * size - total)
    return np.reshape(order, (rounds, num_chunks, size))


def _warned(
    objective_of_softness: Callable[[PyTree], Objective], each: Sequence[PyTree]
) -> tuple[Objective, tuple[tuple[str, ...], ...]]:
    """Return the objective at the last softness, and the scene's warnings at each."""
    objectives, told = [], []
    for one in each:  # outside of a trace, where a scene knows its values
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            objectives.append(objective_of_softness(one))
        messages = [str(warning.message) for warning in caught if issubclass(warning.category, SceneWarning)]
        told.append(tuple(dict.fromkeys(messages)))
    return objectives[-1], tuple(told)


def _summary(samples: Samples, plan: Plan, has_alpha: bool) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the estimates from samples at all points, and by estimate the terms of its mean; NaN in place of missing ones."""
    # The one without noise is the last in what follows, where batches are counted from the first.
    by_noise = jax.tree.map(lambda leaf: jnp.roll(leaf, -plan.with_zero_noise, axis=1), samples)
    samples = jax.vmap(_by_parameters)(by_noise) if plan.by_noise else by_noise
    first, zeroth = jax.vmap(lambda s: both_results(both_summary(s), plan, unchanged))(samples)
    found = {"first": first, "zeroth": zeroth, "alpha_order": None, "cost": jax.vmap(Samples.noise_free_cost)(samples)}
    rollouts = jax.tree.map(lambda leaf: leaf[:, :, 0], samples.rollouts)
    costs = jnp.where(samples.is_noisy & jnp.isfinite(rollouts.cost), rollouts.cost, jnp.nan)[..., None]
    # Leaving one out is replaced by the mean, equal up to 1/N.
    terms = {"first": jnp.where(jnp.isnan(costs), jnp.nan, rollouts.gradient_by_noise)}
    terms["zeroth"] = (costs - jnp.nanmean(costs, axis=1, keepdims=True)) * rollouts.noise_score
    if has_alpha:
        found["alpha_order"], batches = jax.vmap(lambda s, z: _in_batches(s, plan, z))(by_noise, zeroth)
        terms["alpha_order"] = np.sqrt(BATCH) * batches
    return found, terms


def _sampled(
    objective: Objective,
    params: Float[Array, "points dim"],
    key: PRNGKeyArray,
    units: Int[Array, "chunks units"],
    plan: Plan,
) -> Samples:
    """Roll out samples for both estimates; all points share one compiled body."""
    points, chunks = jnp.divmod(jnp.arange(len(params) * len(units)), len(units))

    def one_chunk(point_and_chunk: tuple[Array, Array]) -> Samples:
        point, chunk = point_and_chunk
        return sample(objective, params[point], jax.random.fold_in(key, point), plan, units[chunk])

    samples = jax.lax.map(one_chunk, (points, chunks))
    return jax.tree.map(lambda leaf: leaf.reshape(len(params), units.size, *leaf.shape[2:]), samples)


def _by_parameters(samples: Samples) -> Samples:
    """Apply the chain rule from the noise to the parameters, for the gradient and score of each unit and rollout."""
    vjp = jax.vmap(jax.vmap(lambda pull_back, x: pull_back(x)))
    found = samples.rollouts
    gradients, scores = (vjp(found.pull_back, x) for x in (found.gradient_by_noise, found.noise_score))
    # The standard deviations belong to the noise; the parameters have none.
    unknown = jnp.full_like(scores, jnp.nan)
    rollouts = Differentiated(found.cost, gradients, scores, unknown, Partial(unchanged))
    return dataclasses.replace(samples, rollouts=rollouts)


def _in_batches(
    samples: Samples, plan: Plan, zeroth: GradientEstimate
) -> tuple[GradientEstimate, Float[Array, "batches dim"]]:
    """Return the mean of the α-order estimates, one for each batch of samples, and all of them."""
    count = plan.num_samples // BATCH
    batches = jax.tree.map(lambda leaf: leaf[: count * BATCH].reshape(count, BATCH, *leaf.shape[1:]), samples)

    def one(batch: Samples) -> tuple[Array, Array, Array]:
        parts = both_parts(batch, control_variate=True)
        alpha = weigh(LeastRisk(), parts, plan).alpha
        value, _ = parts.mixture(jnp.broadcast_to(alpha, parts.first.offset.shape))
        return jnp.where(parts.unbiased.count > 1, value, jnp.nan), alpha, parts.unbiased.count > 1

    values, alpha, exists = jax.vmap(one)(batches)
    found = Moments.of(values, exists)
    mean = dataclasses.replace(
        zeroth,
        value=jnp.where(found.count > 1, found.mean, jnp.nan),
        standard_error=jnp.sqrt(found.squared_error()),
        covariance_diagonal=BATCH * found.count * found.squared_error(),
        num_finite=found.count,
        alpha=jnp.nanmean(jnp.where(exists, alpha, jnp.nan)),
    )
    return mean, values


@functools.partial(jax.jit, static_argnames="plan")
def _unbiased(samples: Samples, plan: Plan) -> tuple[Float[Array, "points dim"], Float[Array, "points dim"]]:
    """Return an unbiased gradient at each point and its standard error: that part of α-order, or zeroth order."""

    def one(samples: Samples) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        if not plan.by_noise:
            zeroth = both_results(both_summary(samples), plan, unchanged)[1]
            return zeroth.value, zeroth.standard_error
        parts = both_parts(samples, control_variate=True)
        value, squared_error = parts.mixture(jnp.zeros_like(parts.first.offset))
        return jnp.where(parts.unbiased.count > 1, value, jnp.nan), jnp.sqrt(jnp.maximum(squared_error, 0))

    return jax.vmap(one)(samples)


def _by_landscape(
    objective: ParameterNoise, params: Float[Array, "points dim"], key: PRNGKeyArray, *, num_reference: int
) -> dict[str, Any]:
    """Compute the cost and the reference from one landscape."""
    stddev = jnp.ravel(objective.stddev)[0].astype(params.dtype)
    low, high = params.min() - REACH * stddev, params.max() + REACH * stddev
    points, cell = cell_points(key, low, high, num_reference)
    everywhere = jnp.concatenate([points, params[:, 0]])
    # One body for the landscape and the points: compiling takes longer than running.
    costs = map_in_chunks(lambda x: objective.function(x[None]), everywhere, DEFAULT_CHUNK_SIZE)
    landscape, cost = Landscape(points, costs[:num_reference], cell), costs[num_reference:]
    gradient, error = jax.vmap(landscape.smoothed_gradient, in_axes=(0, None, 0))(params[:, 0], stddev, cost)
    return {"cost": cost, "reference": gradient[:, None], "reference_error": error[:, None], "landscape": landscape}
