"""Many steps in one program: what runs on the device between two looks from the host."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from mjxgrad.optimiser.convergence import Convergence, Recent, has_converged
from mjxgrad.optimiser.method import Method, Record
from mjxgrad.optimiser.result import Stopped

Evaluate = Callable[[Float[Array, " dim"]], Float[Array, ""]]


@dataclasses.dataclass(frozen=True)
class Limits:
    """What a run may do, as far as the device decides it; see `run`."""

    num_steps: int
    segment: int
    evaluate_every: int
    patience: int
    max_rollouts: int | None
    convergence: Convergence | None


class Best(eqx.Module):
    """The best parameters seen, and by what.

    Attributes:
        params: of the lowest cost.
        cost: that cost, NaN before there is one.
        scale: of the smoothing that it was measured under.
        finite_fraction: of the rollouts that it is the mean of.
    """

    params: Float[Array, " dim"]
    cost: Float[Array, ""]
    scale: Float[Array, ""]
    finite_fraction: Float[Array, ""]

    @classmethod
    def measured(cls, params: Float[Array, " dim"], cost: Float[Array, ""]) -> "Best":
        """Give a point with the cost that `evaluate` gave for it, to be compared with its like alone."""
        return cls(params, cost, jnp.zeros_like(cost), jnp.ones_like(cost))

    def against(self, other: "Best") -> "Best":
        """Give the better of both, itself if they are equal.

        Less smoothing wins first, for costs under different noise are not comparable; then the larger share of finite
        rollouts, lest leaving out the ones that diverged pay; then the lower cost.
        """
        is_better = (other.scale < self.scale) | (
            (other.scale == self.scale)
            & (
                (other.finite_fraction > self.finite_fraction)
                | ((other.finite_fraction == self.finite_fraction) & (other.cost < self.cost))
            )
        )
        is_better = jnp.isfinite(other.cost) & (is_better | jnp.isnan(self.cost))
        return jax.tree.map(lambda new, old: jnp.where(is_better, new, old), other, self)


class Carry(eqx.Module):
    """One run between two steps.

    Attributes:
        params: the point.
        state: of the method.
        best: the best point so far.
        recent: by which convergence is judged.
        num_steps: steps done, those not taken included.
        num_skipped: of those, the ones not taken.
        num_in_a_row: of those, the last ones without one taken between.
        num_rollouts: spent.
        stopped: whether and why.
    """

    params: Float[Array, " dim"]
    state: PyTree
    best: Best
    recent: Recent
    num_steps: Int[Array, ""]
    num_skipped: Int[Array, ""]
    num_in_a_row: Int[Array, ""]
    num_rollouts: Int[Array, ""]
    stopped: Stopped

    @classmethod
    def start(cls, method: Method, params: Float[Array, " dim"], convergence: Convergence | None) -> "Carry":
        """Begin at a point."""
        zero, nan = jnp.zeros((), jnp.int32), jnp.full((), jnp.nan, params.dtype)
        best = Best(params, nan, nan + jnp.inf, nan)
        recent = Recent.empty(convergence, params.dtype)
        stopped = jax.tree.map(jnp.asarray, Stopped.running)
        return cls(params, method.init(params), best, recent, zero, zero, zero, zero, stopped)


def run_segment(
    method: Method,
    evaluate: Evaluate | None,
    limits: Limits,
    key: PRNGKeyArray,
    carry: Carry,
    start: Int[Array, ""],
) -> tuple[Carry, tuple[Record, Float[Array, " segment"]]]:
    """Take the steps from `start` on; those after the end or after a stop change nothing.

    A segment always has the same length, so that it is compiled once. The number of a step is not part of the carry:
    over many seeds it is then one number, and what happens only at some steps is skipped at the others for all of them.

    Args:
        method: takes a step.
        evaluate: cost of a point, to be measured now and then.
        limits: when to stop.
        key: of the run; every step draws from `fold_in(key, step)`.
        carry: where the run is.
        start: number of the first step.

    Returns:
        Where the run is now; the records of the steps, and the costs evaluated before them, NaN where there is none.
    """
    dtype = carry.params.dtype
    nothing = Record.blank(dtype), jnp.full((), jnp.nan, dtype)

    def idle(carry: Carry, _: Int[Array, ""]) -> tuple[Carry, Any]:
        return carry, nothing

    def step(carry: Carry, index: Int[Array, ""]) -> tuple[Carry, Any]:
        return _step(method, evaluate, limits, key, carry, index)

    def while_running(carry: Carry, index: Int[Array, ""]) -> tuple[Carry, Any]:
        return jax.lax.cond(carry.stopped == Stopped.running, step, idle, carry, index)

    def body(carry: Carry, index: Int[Array, ""]) -> tuple[Carry, Any]:
        return jax.lax.cond(index < limits.num_steps, while_running, idle, carry, index)

    return jax.lax.scan(body, carry, start + jnp.arange(limits.segment, dtype=jnp.int32))


def _step(
    method: Method,
    evaluate: Evaluate | None,
    limits: Limits,
    key: PRNGKeyArray,
    carry: Carry,
    index: Int[Array, ""],
) -> tuple[Carry, tuple[Record, Float[Array, ""]]]:
    at = carry.params
    noise_free = _evaluated(evaluate, limits, at, index)
    params, state, record = method.advance(at, carry.state, jax.random.fold_in(key, index), index)
    under_noise = Best(at, record.cost, record.scale, record.finite_fraction)
    recent = carry.recent.push(record)
    num_in_a_row = jnp.where(record.is_taken, 0, carry.num_in_a_row + 1)
    num_rollouts = carry.num_rollouts + record.num_rollouts
    moved = Carry(
        params=params.astype(at.dtype),
        state=state,
        best=carry.best.against(under_noise if evaluate is None else Best.measured(at, noise_free)),
        recent=recent,
        num_steps=carry.num_steps + 1,
        num_skipped=carry.num_skipped + ~record.is_taken,
        num_in_a_row=num_in_a_row,
        num_rollouts=num_rollouts,
        stopped=_stopped(
            limits,
            index,
            is_lost=num_in_a_row >= limits.patience,
            has_converged=has_converged(limits.convergence, recent),
            # The next step is taken to cost what this one did.
            next_total=num_rollouts + record.num_rollouts,
        ),
    )
    return moved, (record, noise_free)


def _evaluated(
    evaluate: Evaluate | None, limits: Limits, params: Float[Array, " dim"], index: Int[Array, ""]
) -> Float[Array, ""]:
    nothing = jnp.full((), jnp.nan, params.dtype)
    if evaluate is None:
        return nothing
    return jax.lax.cond(
        index % limits.evaluate_every == 0,
        lambda at: jnp.asarray(evaluate(at), params.dtype),
        lambda _: nothing,
        params,
    )


def _stopped(
    limits: Limits,
    index: Int[Array, ""],
    *,
    is_lost: Bool[Array, ""],
    has_converged: Bool[Array, ""],
    next_total: Int[Array, ""],
) -> Stopped:
    """Say whether to stop after a step, the weightiest reason first."""
    stopped = Stopped.running
    if limits.max_rollouts is not None:
        stopped = Stopped.where(next_total > limits.max_rollouts, Stopped.max_rollouts, stopped)
    stopped = Stopped.where(index + 1 >= limits.num_steps, Stopped.finished, stopped)
    stopped = Stopped.where(has_converged, Stopped.converged, stopped)
    return Stopped.where(is_lost, Stopped.not_finite, stopped)
