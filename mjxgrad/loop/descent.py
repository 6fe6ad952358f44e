"""Descents: methods that improve a vector of parameters, with a history, the best parameters and reasons to stop."""

import dataclasses
import functools
import math
import warnings
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from mjxgrad._arrays import function, one_of, traceable, whole
from mjxgrad._programs import compiled, is_traced
from mjxgrad.estimators.estimate import Reason
from mjxgrad.loop.result import Best, History, Optimisation, Record, Stopped
from mjxgrad.loop.run import Log, Method, Progress, mean, run
from mjxgrad.objective.base import Scalar, Vector, as_scalar, check_vector

# Progress is shown every five per cent; each time costs one return from the device.
NUM_SEGMENTS = 20

# Where nothing was felt and nothing moved, the next step differs only in its noise. Three steps of 50 samples miss a jump
# that one sample in thirty meets with a probability of 0.6 %.
STILL_STEPS = 3


class RunOptions(eqx.Module):
    """The options of every descent.

    Attributes:
        num_steps: largest number of steps.
        evaluate: cost of a point without noise, or any other measure of it; traceable. Its rollouts are not counted, and
            only the choice of the best parameters depends on it.
        evaluate_every: steps between two evaluations, for a cost that is dear beside an estimate: only evaluated points can be
            the best. The last point is always evaluated.
        patience: steps in a row whose estimate is not finite, or whose samples feel nothing (`Reason.nothing_felt`), before
            the run gives up. If such steps do not move the parameters either, three in a row are enough.
        log: function called after every twentieth of the steps: `lambda step, metrics: wandb.log(dict(metrics), step=step)`.
            The metrics are the fields of `History` at the last step, the mean over the seeds that took it, and `best_cost`.
        checkpoint: file to save the run in, as often, and to resume it from, also with more steps. On the same device a
            resumed run gives the result of an uninterrupted one to the bit, except for the seconds.
        progress: whether a run of more than ten seconds tells on stderr what it will take, and how far it is.
    """

    num_steps: int = eqx.field(converter=functools.partial(whole, "num_steps"))
    evaluate: Callable[[Vector], Scalar] | None = None
    evaluate_every: int = eqx.field(default=1, converter=functools.partial(whole, "evaluate_every"))
    patience: int = eqx.field(default=10, converter=functools.partial(whole, "patience"))
    log: Log | None = None
    checkpoint: str | Path | None = None
    progress: bool = True

    def __check_init__(self):
        function("evaluate", self.evaluate, "params")

    @classmethod
    def of(cls, num_steps: int, options: dict[str, Any]) -> "RunOptions":
        """Return options from those of a call; refuse others by name."""
        for name in options:
            one_of("an option", name, [field.name for field in dataclasses.fields(cls)][1:])
        return cls(num_steps, **options)


class Carry(eqx.Module):
    """The state of one run between two steps; see also `Optimisation`."""

    params: Vector
    state: PyTree  # the method's own state
    key: PRNGKeyArray  # key of the run; the noise of a step comes from it and the number of the step
    best: Best
    num_in_a_row: Int[Array, ""]  # length of the present row of steps not taken
    num_still: Int[Array, ""]  # length of the present row of steps that felt nothing
    stopped: Stopped


class Descent(Method):
    """A method for a vector of parameters; a subclass gives `init_state`, and a `step` that ends in `moved`."""

    options: RunOptions

    @abstractmethod
    def init_state(self, params: Vector) -> PyTree:
        """Return the first state of the method, carried from step to step beside the parameters."""

    def run(self, params: Float[Array, "..."], key: Key[Array, "..."]) -> Optimisation:
        """Run the method from a vector; with a leading axis of keys, one start per key."""
        if is_traced((self, params, key)):
            raise ValueError(
                "optimise must be called outside of jax.jit and jax.vmap, got a traced value; it compiles its own program, "
                "and takes one key per seed"
            )
        given: Any = key if eqx.is_array(key) else np.asarray(key)  # of anything
        key, params = given, jnp.asarray(params)
        if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.ndim > 1:
            raise ValueError(
                f"key must come from jax.random.key, with at most one leading axis, got {key.dtype} of shape {key.shape}; "
                "jax.random.split(jax.random.key(0), num_seeds) gives one per seed"
            )
        if params.ndim == 2 and key.shape != params.shape[:1]:
            raise ValueError(
                f"params must have a leading axis only where key has the same, got shapes {params.shape} and {key.shape}; "
                "jax.random.split(key, len(params)) gives a key for each, and a matrix of controls is {'controls': matrix} here"
            )
        check_vector(params.shape[params.ndim == 2 :], params.dtype)
        if not jnp.isfinite(params).all():
            raise ValueError(f"params must be finite at the start, got {params}")
        options = {name: getattr(self.options, name) for name in ("num_steps", "log", "checkpoint", "progress")}
        options |= {"over": [None] * key.ndim, "segment": math.ceil(self.options.num_steps / NUM_SEGMENTS)}
        return run(self, (jnp.broadcast_to(params, (*key.shape, params.shape[-1])), key), **options)

    def init(self, start: tuple[Vector, PRNGKeyArray]) -> Carry:
        params, key = start
        nan = jnp.full((), jnp.nan, params.dtype)
        best = Best(params, nan, nan + jnp.inf, nan)
        zero, stopped = jnp.zeros((), jnp.int32), jax.tree.map(jnp.asarray, Stopped.running)
        return Carry(params, self.init_state(params), key, best, zero, zero, stopped)

    def moved(
        self, carry: Carry, index: Int[Array, ""], params: Vector, state: PyTree, record: Record
    ) -> tuple[Carry, Record]:
        """Return the carry after a step, and the record of the step; nothing changes where a run has stopped.

        `params` and `state` are those after the step; unchanged, with `record.is_taken` False, if it could not be taken.
        """
        options, at, nan = self.options, carry.params, jnp.full((), jnp.nan, carry.params.dtype)
        candidate = Best(at, record.cost, record.scale, record.finite_fraction)
        if (evaluate := options.evaluate) is not None:
            is_due = index % options.evaluate_every == 0
            cost = lambda x: _evaluated(evaluate, x)  # noqa: E731
            record = dataclasses.replace(record, noise_free_cost=jax.lax.cond(is_due, cost, lambda _: nan, at))
            candidate = Best.measured(at, record.noise_free_cost)
        num_in_a_row = jnp.where(record.is_taken, 0, carry.num_in_a_row + 1)
        num_still = jnp.where(record.reason == Reason.nothing_felt, carry.num_still + 1, 0)
        # Later reasons to stop override earlier ones. That all steps are done is no part of it: a run may go on with more.
        enough = jnp.where(record.step_norm == 0, min(STILL_STEPS, options.patience), options.patience)
        stopped = Stopped.where(num_still >= enough, Stopped.nothing_felt, Stopped.running)
        stopped = Stopped.where(num_in_a_row >= options.patience, Stopped.not_finite, stopped)
        best = carry.best.against(candidate)
        after = Carry(params, state, carry.key, best, num_in_a_row, num_still, stopped)
        # One of several runs may have stopped before the others.
        as_it_was, as_it_is = (carry, Record.blank(at.dtype)), (after, record)
        return jax.tree.map(lambda old, new: jnp.where(self.is_over(carry), old, new), as_it_was, as_it_is)

    def is_over(self, carry: Carry) -> Bool[Array, "..."]:
        return carry.stopped != Stopped.running

    def identity(self) -> dict[str, Any]:
        return {name: getattr(self.options, name) for name in ("evaluate_every", "patience")}

    def learnt(self, carry: Carry) -> PyTree:
        return carry.params

    def metrics(self, progress: Progress, count: int) -> dict[str, float]:
        """Return the fields of the last step, the mean over the seeds that took it; NaN for fields without a value."""
        history = History.of(progress)
        last = {f.name: getattr(history, f.name)[..., -1] for f in dataclasses.fields(History) if f.name != "reason"}
        return {name: mean(x) for name, x in (last | {"best_cost": np.asarray(progress.carry.best.cost)}).items()}

    def result(self, progress: Progress) -> Optimisation:
        carry, history = progress.carry, History.of(progress)
        best, final_cost = carry.best, jnp.full_like(carry.best.cost, jnp.nan)
        was_done = np.isfinite(history.scale)  # NaN in steps that did not happen
        num_steps = was_done.sum(axis=-1)
        chosen = lambda of, one, other: jax.tree.map(lambda x, y: jnp.where(of, x, y), one, other)  # noqa: E731
        at_end = Stopped.interrupted if progress.is_interrupted else Stopped.finished
        at_end = chosen(carry.num_in_a_row >= num_steps, Stopped.not_finite, at_end)
        stopped = chosen(carry.stopped == Stopped.running, at_end, carry.stopped)
        if np.any(untouched := was_done.any(axis=-1) & ~history.is_taken.any(axis=-1)):
            is_rule = np.isfinite(history.gradient_norm[untouched]).all()
            reason = (
                "its learning rate gives NaN or infinity" if is_rule else "costs or derivatives were NaN or infinite"
            )
            warnings.warn(f"optimise has changed nothing, no step was taken: {reason}", stacklevel=2)
        if self.options.evaluate is not None and not progress.is_interrupted:
            final_cost, best = _finish(self.options.evaluate, carry.params, best)
        return Optimisation(
            params=carry.params,
            best_params=best.params,
            best_cost=best.cost,
            final_cost=final_cost,
            history=history,
            stopped=stopped,
            num_steps=np.asarray(num_steps),
            num_skipped=np.asarray((was_done & ~history.is_taken).sum(axis=-1)),
            num_rollouts=history.num_rollouts[..., -1],
            num_gradient_rollouts=history.num_gradient_rollouts[..., -1],
            seconds=float(progress.seconds.sum()),
            compile_seconds=progress.compile_seconds,
        )


def _evaluated(evaluate: Any, at: Vector) -> Scalar:
    with traceable("evaluate"):
        found = evaluate(at)
    return as_scalar(found, "evaluate").astype(at.dtype)


@compiled
def _finish(evaluate: Any, params: Float[Array, "*seeds dim"], best: Best) -> tuple[Float[Array, "*seeds"], Best]:
    """Measure the last point, of many seeds each; it competes with the best before."""

    def finish(at: Vector, best: Best) -> tuple[Scalar, Best]:
        cost = _evaluated(evaluate, at)
        return cost, best.against(Best.measured(at, cost))

    return (jax.vmap(finish) if params.ndim == 2 else finish)(params, best)
