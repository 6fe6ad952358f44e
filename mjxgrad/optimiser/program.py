"""One compiled segment, for one run or for many, and what goes in and out of it."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mjxgrad.optimiser import checkpoint as checkpoints
from mjxgrad.optimiser.method import Method, Record
from mjxgrad.optimiser.result import History, Progress, Stopped
from mjxgrad.optimiser.segment import Best, Carry, Evaluate, Limits, run_segment


class Saved(NamedTuple):
    """All that an interrupted run needs to go on; `trace` has the steps of all segments so far on its last axis."""

    carry: Carry
    trace: tuple[Record, Float[np.ndarray, "..."]]
    seconds: Float[np.ndarray, " steps"]


class Program:
    """A method made ready to run.

    Attributes:
        limits: of the run.
        params: the start, with a leading axis if the key has one.
        key: of the run, or one per seed.
        carry: before the first step.
        compile_seconds: spent on tracing and compiling the segment so far.
    """

    def __init__(
        self,
        method: Method,
        evaluate: Evaluate | None,
        limits: Limits,
        params: Float[Array, "..."],
        key: Key[Array, "..."],
    ):
        self.limits, self.params, self.key, self.compile_seconds = limits, params, key, 0.0
        self.arrays, static = eqx.partition((method, evaluate), eqx.is_array)
        self._compiled = self._lowered = None

        def over_seeds(function: Callable, *in_axes: int | None) -> Callable:
            return jax.vmap(function, in_axes) if key.ndim else function

        def start(arrays: PyTree, params: Float[Array, " dim"]) -> Carry:
            return Carry.start(eqx.combine(arrays, static)[0], params, limits.convergence)

        def advance(arrays: PyTree, key: Key[Array, ""], carry: Carry, index: Array) -> tuple[Carry, Any]:
            method, evaluate = eqx.combine(arrays, static)
            return run_segment(method, evaluate, limits, key, carry, index)

        def finish(arrays: PyTree, carry: Carry) -> tuple[Float[Array, ""], Best]:
            measure, params = eqx.combine(arrays, static)[1], carry.params
            if measure is None:
                return jnp.full((), jnp.nan, params.dtype), carry.best
            cost = jnp.asarray(measure(params), params.dtype)
            return cost, carry.best.against(Best.measured(params, cost))

        self._start = jax.jit(over_seeds(start, None, 0))
        self._advance = jax.jit(over_seeds(advance, None, 0, 0, None))
        self._finish = jax.jit(over_seeds(finish, None, 0))
        self.carry = self._start(self.arrays, params)

    def start(self) -> Saved:
        """Give the run before its first step."""
        nothing = Record.blank(self.params.dtype), jnp.zeros((), self.params.dtype)
        empty = jax.tree.map(lambda leaf: np.zeros((*self.key.shape, 0), leaf.dtype), nothing)
        return Saved(self.carry, empty, np.zeros(0))

    def advance(self, saved: Saved) -> Saved:
        """Run one segment more."""
        if self._compiled is None:
            lowered = self._lower()
            began = time.perf_counter()
            self._compiled = lowered.compile()
            self.compile_seconds += time.perf_counter() - began
        began = time.perf_counter()
        index = jnp.asarray(saved.seconds.size, jnp.int32)
        carry, trace = jax.block_until_ready(self._compiled(self.arrays, self.key, saved.carry, index))
        seconds = time.perf_counter() - began
        done = int(np.max(carry.num_steps)) - int(np.max(saved.carry.num_steps))
        # Steps after a stop take no time worth the name.
        spent = np.where(np.arange(self.limits.segment) < done, seconds / max(done, 1), 0.0)
        joined = jax.tree.map(lambda old, new: np.concatenate([old, np.asarray(new)], axis=-1), saved.trace, trace)
        return Saved(carry, joined, np.concatenate([saved.seconds, spent]))

    def progress(self, saved: Saved) -> Progress:
        """Tell how far the run is."""
        carry = saved.carry
        return Progress(
            step=int(np.max(carry.num_steps)),
            num_steps=self.limits.num_steps,
            params=carry.params,
            best_cost=carry.best.cost,
            history=self.history(saved),
            seconds=float(saved.seconds.sum()),
            num_running=int(np.sum(carry.stopped == Stopped.running)),
        )

    def history(self, saved: Saved) -> History:
        """Put the history together, as far as any run has come."""
        return History.of(*saved.trace, saved.seconds)[: int(np.max(saved.carry.num_steps))]

    def finish(self, carry: Carry) -> tuple[Float[Array, "..."], Best]:
        """Evaluate the last point, and let it compete with the best before."""
        return self._finish(self.arrays, carry)

    def fingerprint(self) -> dict[str, Any]:
        """Say what a resumed run must have in common with this one: the program itself, and all that it is given."""
        limits = self.limits
        return {
            "num_steps": limits.num_steps,
            "segment": limits.segment,
            "evaluate_every": limits.evaluate_every,
            "patience": limits.patience,
            "max_rollouts": limits.max_rollouts,
            "convergence": repr(limits.convergence),
            "shape": list(self.params.shape),
            "dtype": str(self.params.dtype),
            "start": checkpoints.digest((self.params, self.key)),
            "arrays": checkpoints.digest(self.arrays),
            # The lowered program has every number in it that is not an argument, such as a learning rate.
            "program": checkpoints.digest(np.frombuffer(self._lower().as_text().encode(), np.uint8)),
        }

    def _lower(self) -> Any:
        if self._lowered is None:
            began = time.perf_counter()
            self._lowered = self._advance.lower(self.arrays, self.key, self.carry, jnp.zeros((), jnp.int32))
            self.compile_seconds += time.perf_counter() - began
        return self._lowered
