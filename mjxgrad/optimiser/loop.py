"""The loop that every method runs in: segments on the device; budgets, callbacks and checkpoints between them."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mjxgrad.optimiser import checkpoint as checkpoints
from mjxgrad.optimiser.convergence import Convergence
from mjxgrad.optimiser.method import Method
from mjxgrad.optimiser.program import Program, Saved
from mjxgrad.optimiser.result import Optimisation, Progress, Stopped
from mjxgrad.optimiser.segment import Evaluate, Limits

# Progress shows in steps of five per cent; each costs one return from the device.
DEFAULT_NUM_SEGMENTS = 20


class RunOptions(TypedDict, total=False):
    """What every method's run can be told besides the method.

    Attributes:
        evaluate: cost of a point without noise, or any other measure of it; traceable. It is measurement: the rollouts
            in it are not counted, and nothing but the choice of the best parameters depends on it.
        evaluate_every: steps between two evaluations; 10 if not given. The last point is always evaluated.
        patience: steps in a row whose estimate is not finite before the run gives up; 10 if not given.
        convergence: when to stop early.
        max_rollouts: budget, per run. A step begins if one as dear as the last fits in, so it is kept by methods whose
            steps cost the same, from the second step on: the first is always done.
        max_seconds: budget of wall-clock time for all seeds together, without compilation; looked at after every
            segment.
        segment: steps in one program; a twentieth of all if not given.
        callback: called after every segment; True stops.
        checkpoint: file to save the run in after segments and to resume it from. A resumed run gives, on the same
            device, bit for bit what the uninterrupted one would have given, its seconds apart.
        checkpoint_every: segments between two saves; 1 if not given. An interrupted run is saved in any case.
    """

    evaluate: Evaluate | None
    evaluate_every: int
    patience: int
    convergence: Convergence | None
    max_rollouts: int | None
    max_seconds: float | None
    segment: int | None
    callback: Callable[[Progress], bool | None] | None
    checkpoint: str | Path | None
    checkpoint_every: int


def run(
    method: Method,
    params: Float[Array, "..."],
    key: Key[Array, "..."],
    *,
    num_steps: int,
    evaluate: Evaluate | None = None,
    evaluate_every: int = 10,
    patience: int = 10,
    convergence: Convergence | None = None,
    max_rollouts: int | None = None,
    max_seconds: float | None = None,
    segment: int | None = None,
    callback: Callable[[Progress], bool | None] | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 1,
) -> Optimisation:
    """Run a method, from one start or from many at once.

    Args:
        method: takes the steps.
        params: the start, a vector; or one per seed.
        key: of the run; with a leading axis, one per seed, and all of them run in one program.
        num_steps: at most.
        evaluate: see `RunOptions`, as all that follow.
        evaluate_every: likewise.
        patience: likewise.
        convergence: likewise.
        max_rollouts: likewise.
        max_seconds: likewise.
        segment: likewise.
        callback: likewise.
        checkpoint: likewise.
        checkpoint_every: likewise.

    Returns:
        The result; its leaves have a leading axis if `key` has one.

    Raises:
        ValueError: if a number is out of range, the shapes of `params` and `key` do not fit, or the checkpoint is damaged
            or of another run, or its folder does not exist.
    """
    counts = {"num_steps": num_steps, "evaluate_every": evaluate_every, "patience": patience}
    _refuse_numbers(counts | {"checkpoint_every": checkpoint_every}, segment, max_rollouts, max_seconds)
    segment = segment or math.ceil(num_steps / DEFAULT_NUM_SEGMENTS)
    limits = Limits(num_steps, segment, evaluate_every, patience, max_rollouts, convergence)
    program = Program(method, evaluate, limits, *_matched(params, key))
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and not path.parent.is_dir():
        raise ValueError(f"checkpoint must be in a folder that exists, got {path}; make {path.parent} first")

    saved, fingerprint = program.start(), {}
    if path is not None:
        fingerprint = program.fingerprint()
        if path.exists():
            saved = checkpoints.load(path, saved, fingerprint)
    saved, stopped = _loop(program, saved, max_seconds, callback, path, checkpoint_every, fingerprint)
    return _result(program, saved, stopped)


def _loop(
    program: "Program",
    saved: Saved,
    max_seconds: float | None,
    callback: Callable[[Progress], bool | None] | None,
    path: Path | None,
    checkpoint_every: int,
    fingerprint: dict[str, Any],
) -> tuple[Saved, Stopped]:
    """Run segments until every run has stopped, and say why each did."""
    segment, on_disk = program.limits.segment, saved.seconds.size
    reason = None
    try:
        while reason is None and np.any(saved.carry.stopped == Stopped.running):
            if max_seconds is not None and saved.seconds.sum() >= max_seconds:
                reason = Stopped.max_seconds
                break
            saved = program.advance(saved)
            if path is not None and saved.seconds.size - on_disk >= checkpoint_every * segment:
                checkpoints.save(path, saved, fingerprint)
                on_disk = saved.seconds.size
            if callback is not None and callback(program.progress(saved)):
                reason = Stopped.interrupted
    finally:
        # On the way out of an interruption, too: KeyboardInterrupt goes on to the caller.
        if path is not None and saved.seconds.size > on_disk:
            checkpoints.save(path, saved, fingerprint)
    stopped = saved.carry.stopped
    if reason is not None:
        stopped = Stopped.where(stopped == Stopped.running, reason, stopped)
    return saved, stopped


def _result(program: Program, saved: Saved, stopped: Stopped) -> Optimisation:
    carry, history = saved.carry, program.history(saved)
    final_cost, best = program.finish(carry)
    return Optimisation(
        params=carry.params,
        best_params=best.params,
        best_cost=best.cost,
        final_cost=final_cost,
        history=history,
        stopped=stopped,
        num_steps=np.asarray(carry.num_steps),
        num_skipped=np.asarray(carry.num_skipped),
        num_rollouts=history.num_rollouts[..., -1],
        num_gradient_rollouts=history.num_gradient_rollouts[..., -1],
        seconds=float(saved.seconds.sum()),
        compile_seconds=program.compile_seconds,
    )


def _matched(params: Float[Array, "..."], key: Key[Array, "..."]) -> tuple[Float[Array, "..."], Key[Array, "..."]]:
    """Give parameters a leading axis where the key has one."""
    key, params = jnp.asarray(key), jnp.asarray(params)
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.ndim > 1:
        raise ValueError(
            f"key must come from jax.random.key, with at most one leading axis, got {key.dtype} of shape {key.shape}; "
            "jax.random.split(jax.random.key(0), num_seeds) gives one per seed"
        )
    if not jnp.issubdtype(params.dtype, jnp.floating):
        raise ValueError(f"params must be floating-point, got {params.dtype}; write 1.0 in place of 1")
    if params.ndim == 2 and key.shape != params.shape[:1]:
        raise ValueError(
            f"params must have a leading axis only where key has the same, got shapes {params.shape} and {key.shape}; "
            "jax.random.split(key, len(params)) gives a key for each"
        )
    if params.ndim not in (1, 2):
        raise ValueError(
            f"params must be a vector of shape (dim,), or one per seed, got shape {params.shape}; "
            "use jnp.atleast_1d for one number, objective.ravel for a pytree"
        )
    return jnp.broadcast_to(params, (*key.shape, params.shape[-1])), key


def _refuse_numbers(
    counts: dict[str, int], segment: int | None, max_rollouts: int | None, max_seconds: float | None
) -> None:
    if segment is not None:
        counts = counts | {"segment": segment}
    if max_rollouts is not None:
        counts = counts | {"max_rollouts": max_rollouts}
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    # Rollouts are counted on the device in 32 bits, where a step beyond the budget must still fit in.
    if max_rollouts is not None and max_rollouts >= 2**30:
        raise ValueError(f"max_rollouts must be below 2**30, got {max_rollouts}; leave it out for no limit")
    if max_seconds is not None and not max_seconds > 0:
        raise ValueError(f"max_seconds must be positive, got {max_seconds}")
