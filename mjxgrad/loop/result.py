"""The result of a descent: last and best parameters, the history, and the reason for stopping."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from mjxgrad._arrays import is_known
from mjxgrad._text import Printed, format_number, format_range
from mjxgrad.estimators import Reason
from mjxgrad.loop.run import Progress


class Stopped(eqx.Enumeration):
    """The reason why a run stopped; `Stopped[optimisation.stopped]` is the sentence, for one run."""

    running = "it has not stopped"
    finished = "all steps were done"
    interrupted = "it was interrupted"
    not_finite = "too many estimates in a row were not finite"
    nothing_felt = (
        "in several steps in a row all samples cost the same and no derivative differed from zero: nothing that the "
        "parameters change reaches the cost"
    )


_BEYOND = 3.0  # errors by which the last step's cost is clearly another
_CLEARLY = 0.01  # share of a cost by which it is at least, also without noise
# Arrays of JAX in the loop, of NumPy afterwards.
Numbers, Counts = Float[Any, "..."], Int[Any, "..."]


class Record(eqx.Module):
    """The record of one step of one run; NaN in fields that a method does not have.

    Attributes:
        cost: mean cost under noise at the parameters before the step.
        cost_error: standard error of `cost`.
        gradient_norm: norm of the estimate.
        alpha: weight of the first-order part.
        reason: reason for `alpha`.
        scale: scale of the annealing; 1 without annealing.
        step_norm: norm of the change of the parameters.
        finite_fraction: share of the samples that were finite.
        num_rollouts: rollouts spent by the step.
        num_gradient_rollouts: rollouts that were differentiated.
        is_taken: False for a step whose estimate was not finite.
        noise_free_cost: result of `evaluate` at the parameters before the step, NaN where it was not due.
    """

    cost: Numbers
    cost_error: Numbers
    gradient_norm: Numbers
    alpha: Numbers
    reason: Reason
    scale: Numbers
    step_norm: Numbers
    finite_fraction: Numbers
    num_rollouts: Counts
    num_gradient_rollouts: Counts
    is_taken: Bool[Any, "..."]
    noise_free_cost: Numbers

    @classmethod
    def blank(cls, dtype: jnp.dtype) -> "Record":
        """Return the record of a step that did not happen."""
        nan, none = jnp.full((), jnp.nan, dtype), jnp.zeros((), jnp.int32)
        # As an array, like the reasons of steps.
        reason = jax.tree.map(jnp.asarray, Reason.fixed)
        return cls(nan, nan, nan, nan, reason, nan, nan, nan, none, none, jnp.zeros((), bool), nan)


class Best(eqx.Module):
    """The parameters of lowest cost, with the cost (NaN before there is one) and how it was measured."""

    params: Float[Array, " dim"]
    cost: Float[Array, ""]
    scale: Float[Array, ""]
    finite_fraction: Float[Array, ""]

    @classmethod
    def measured(cls, params: Float[Array, " dim"], cost: Float[Array, ""]) -> "Best":
        """Return a point with its cost from `evaluate`, to be compared only with other evaluated points."""
        return cls(params, cost, jnp.zeros_like(cost), jnp.ones_like(cost))

    def against(self, other: "Best") -> "Best":
        """Return the better of both points, this one if they are equal.

        Less smoothing wins first, because costs under different noise are not comparable. Then the larger share of finite
        rollouts wins, so that divergence does not pay; then the lower cost.
        """
        mine, theirs = self.finite_fraction, other.finite_fraction
        is_better = jnp.where(theirs == mine, other.cost < self.cost, theirs > mine)
        is_better = jnp.where(other.scale == self.scale, is_better, other.scale < self.scale)
        is_better = jnp.isfinite(other.cost) & (is_better | jnp.isnan(self.cost))
        return jax.tree.map(lambda new, old: jnp.where(is_better, new, old), other, self)


class History(Record, Printed):
    """A run step by step: with many seeds, leaves have seeds on the first axis; steps are on the last.

    The fields are those of `Record`, in NumPy, with cumulative counts. After a run stopped before the others its fields
    are NaN and its counts stay constant.

    Attributes:
        seconds: wall-clock time up to the end of the step, the same for all seeds; see `Progress`.
    """

    seconds: Float[np.ndarray, " steps"]

    def __str__(self) -> str:
        at = [format_range((float(np.nanmin(x)), float(np.nanmax(x)))) for x in (self.cost[..., 0], self.cost[..., -1])]
        text = f"{len(self.seconds)} steps: mean cost under noise {at[0]} at first, {at[1]} at last"
        return f"{text}{self.about_alpha}."

    @property
    def about_alpha(self) -> str:
        """The mean α and its usual reason, as the end of a sentence; empty where the method has none."""
        if not np.isfinite(self.alpha).any():
            return ""
        usual = np.bincount(np.ravel(jax.tree.leaves(self.reason)[0])).argmax()
        reason = Reason[jax.tree.map(lambda _: jnp.asarray(usual), Reason.fixed)]
        return f"; α {np.nanmean(self.alpha):.2g} in the mean, mostly since {reason}"

    @classmethod
    def of(cls, progress: Progress) -> "History":
        """Return the history from the records of a descent."""
        records = jax.tree.map(lambda x: np.moveaxis(x, 0, -1), progress.found)
        fields = {field.name: getattr(records, field.name) for field in dataclasses.fields(Record)}
        for name in ("num_rollouts", "num_gradient_rollouts"):
            # In 64 bits: long runs of large batches exceed 2³¹ rollouts.
            fields[name] = np.cumsum(fields[name], axis=-1, dtype=np.int64)
        return cls(**fields, seconds=np.cumsum(progress.seconds))


class Optimisation(eqx.Module, Printed):
    """The result of a run, or of one run per seed; all fields but the seconds then have a leading axis.

    Attributes:
        params: parameters after the last step, in the form of the start.
        best_params: parameters with the lowest cost seen. With `evaluate` this is the noise-free cost at the steps where
            it was due, or at the end. Otherwise it is the mean cost under noise: less smoothing comes first, then a larger
            share of finite rollouts, then lower cost. The lowest of many noisy means is biased low: prefer `evaluate`.
        best_cost: cost of `best_params`; NaN if there is none.
        final_cost: cost of `params` from `evaluate`; NaN without it.
        history: history, step by step.
        stopped: an item of `Stopped`.
        num_steps: steps done, those not taken included.
        num_skipped: steps not taken because the estimate was not finite.
        num_rollouts: rollouts spent by the method; those in `evaluate` are not counted.
        num_gradient_rollouts: rollouts that were differentiated.
        seconds: wall-clock time of the run without compilation, over all sessions if it was resumed.
        compile_seconds: time of tracing and compilation in this session.
    """

    params: PyTree
    best_params: PyTree
    best_cost: Float[Array, "..."]
    final_cost: Float[Array, "..."]
    history: History
    stopped: Stopped
    num_steps: Int[np.ndarray, "..."]
    num_skipped: Int[np.ndarray, "..."]
    num_rollouts: Int[np.ndarray, "..."]
    num_gradient_rollouts: Int[np.ndarray, "..."]
    seconds: float
    compile_seconds: float

    def __str__(self) -> str:
        span = lambda x, *between: format_range((float(np.min(x)), float(np.max(x))), *between)  # noqa: E731
        steps, rollouts, skipped = map(span, (self.num_steps, self.num_rollouts, self.num_skipped))
        last, error, is_worse = self._at_last()
        best, last = span(self.best_cost, " to "), span(last, " to ")
        last += "" if np.isnan(error).all() else f" ± {format_number(float(np.nanmax(error)))}"
        kind = "cost" if np.isfinite(self.history.noise_free_cost).any() else "mean cost under noise"
        runs = [jax.tree.map(lambda x, i=i: jnp.ravel(x)[i], self.stopped) for i in range(np.size(self.num_steps))]
        reasons = "; ".join(dict.fromkeys(Stopped[run] for run in runs))
        spent = f"{self.seconds:.3g} s, and {self.compile_seconds:.3g} s to compile"
        text = f"Best {kind} {best} (best_params), at the last step {last} (params), after {steps} steps, {skipped} skipped: "
        if is_worse.any():
            whose = "The" if len(runs) == 1 else f"In {is_worse.sum()} of {len(runs)} runs the"
            text = f"{whose} last step is clearly worse than the best: take result.best_params. {text}"
        return f"{text}{reasons}{self.history.about_alpha}. {rollouts} rollouts took {spent}."

    def __repr__(self) -> str:
        is_told = all(
            map(is_known, jax.tree.leaves((self.best_cost, self.final_cost, self.stopped, self.history.cost)))
        )
        return f"Optimisation({self})" if is_told else super().__repr__()

    def _at_last(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return each run's last measured cost, its error (NaN without noise), and whether it is clearly above the best."""
        best, final = (np.atleast_1d(x) for x in (self.best_cost, self.final_cost))
        names = ("noise_free_cost", "cost", "cost_error", "scale")
        free, cost, error, scale = (np.reshape(getattr(self.history, name), (best.size, -1)) for name in names)
        runs, is_evaluated = np.arange(best.size), np.isfinite(free).any()
        known = free if is_evaluated else cost
        last = known.shape[1] - 1 - np.isfinite(known)[:, ::-1].argmax(axis=1)
        found = np.where(np.isnan(final), known[runs, last], final)
        off_by, room, is_alike = np.full(best.size, np.nan), 0.0, True
        if not is_evaluated:
            at = np.abs(np.where(np.isnan(cost), np.inf, cost) - best[:, None]).argmin(axis=1)
            off_by = error[runs, last]
            # The lowest of n noisy means is some √(2 ln n) errors too low.
            room = _BEYOND * off_by + np.sqrt(2 * np.log(cost.shape[1])) * error[runs, at]
            is_alike = scale[runs, at] == scale[runs, last]  # costs under different noise are not comparable
        size = np.maximum(np.abs(found), np.abs(best))
        return found, off_by, is_alike & (found - best > np.maximum(room, _CLEARLY * size))
