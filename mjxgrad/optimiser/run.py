"""The loop that every method runs in: segments of steps on the device; logs and checkpoints between them."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, PyTree

from mjxgrad._arrays import whole
from mjxgrad._programs import compile_once
from mjxgrad.estimators.estimate import Estimator, Reason
from mjxgrad.objective import Objective, flattened, of_vector
from mjxgrad.objective.parameters import Restored
from mjxgrad.optimiser import checkpoint
from mjxgrad.optimiser.result import Best, History, Optimisation, Record, Stopped
from mjxgrad.optimiser.step import AnnealedObjective, Annealing, GradientStep, Method

# Progress shows in steps of five per cent; each costs one return from the device.
NUM_SEGMENTS = 20

# Where nothing was felt and nothing moved, the next step differs by its noise alone. Three draws of it: a jump that one
# sample in thirty meets goes unseen by three steps of 50 with a chance of 0.6 %.
STILL_STEPS = 3


def _as_path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)


class RunOptions(eqx.Module):
    """What every run can be told besides its method.

    Attributes:
        num_steps: at most.
        evaluate: cost of a point without noise, or any other measure of it; traceable. It is measurement: the rollouts
            in it are not counted, and nothing but the choice of the best parameters depends on it.
        evaluate_every: steps between two evaluations. The last point is always evaluated.
        patience: steps in a row whose estimate is not finite, or whose samples feel nothing (`Reason.nothing_felt`), before
            the run gives up; if such steps do not move the parameters either, three in a row are enough.
        log: called after every twentieth of the steps with those done and what `History` has of the last one, the mean over
            the seeds that took it, and `best_cost`: `lambda step, metrics: wandb.log(dict(metrics), step=step)`.
        checkpoint: file to save the run in, as often, and to resume it from. A resumed run gives, on the same device, bit
            for bit what the uninterrupted one would have given, its seconds apart.
        checkpoint_every: twentieths of the steps between two saves. An interrupted run is saved in any case.
    """

    num_steps: int
    evaluate: Callable[[Float[Array, " dim"]], Float[Array, ""]] | None = None
    evaluate_every: int = 10
    patience: int = 10
    log: Callable[[int, Mapping[str, float]], None] | None = None
    checkpoint: Path | None = eqx.field(default=None, converter=_as_path)
    checkpoint_every: int = 1

    def __check_init__(self):
        for name in ("num_steps", "evaluate_every", "patience", "checkpoint_every"):
            whole(name, getattr(self, name))
        if self.checkpoint is not None and not self.checkpoint.parent.is_dir():
            folder = self.checkpoint.parent
            raise ValueError(f"checkpoint must be in a folder that exists, got {self.checkpoint}; make {folder} first")

    @property
    def segment_size(self) -> int:
        """Return the number of steps in one program."""
        return math.ceil(self.num_steps / NUM_SEGMENTS)


class Carry(eqx.Module):
    """One run between two steps.

    Of the steps done, `num_steps`, some were not taken, the last `num_in_a_row` of them in a row; the last `num_still` felt
    nothing.
    """

    params: Float[Array, " dim"]
    state: PyTree
    best: Best
    num_steps: Int[Array, ""]
    num_skipped: Int[Array, ""]
    num_in_a_row: Int[Array, ""]
    num_still: Int[Array, ""]
    stopped: Stopped


class Saved(NamedTuple):
    """All that an interrupted run needs to go on; `trace` has the steps of all segments so far on its last axis."""

    carry: Carry
    trace: tuple[Record, Float[np.ndarray, "..."]]
    seconds: Float[np.ndarray, " steps"]

    def history(self) -> History:
        """Put the history together, as far as any run has come, counts and seconds summed up."""
        records, noise_free_cost = self.trace
        fields = {field.name: getattr(records, field.name) for field in dataclasses.fields(Record)}
        for name in ("num_rollouts", "num_gradient_rollouts"):
            # In 64 bits: long runs of large batches exceed 2³¹ rollouts.
            fields[name] = np.cumsum(fields[name], axis=-1, dtype=np.int64)
        history = History(**fields, noise_free_cost=noise_free_cost, seconds=np.cumsum(self.seconds))
        return history[: int(np.max(self.carry.num_steps))]

    def metrics(self) -> dict[str, float]:
        """Give the last step, the mean over the seeds that took it; NaN where there is no such thing."""
        history = self.history()
        last = {f.name: getattr(history, f.name)[..., -1] for f in dataclasses.fields(History) if f.name != "reason"}
        finite = {
            name: x[np.isfinite(x)] for name, x in (last | {"best_cost": np.asarray(self.carry.best.cost)}).items()
        }
        return {name: float(x.mean()) if x.size else math.nan for name, x in finite.items()}


def optimise(
    objective: Objective | AnnealedObjective,
    params: PyTree,
    key: Key[Array, "..."],
    *,
    estimator: Estimator,
    optimiser: optax.GradientTransformation,
    num_steps: int,
    annealing: Annealing | None = None,
    clip_norm: float | None = None,
    **options: Any,
) -> Optimisation:
    r"""Minimise a cost under noise by descent along estimated gradients.

        estimator = functools.partial(mg.estimators.zeroth_order, num_samples=64)
        result = mg.optimise(
            objective, params, jax.random.key(0),
            estimator=estimator, optimiser=optax.adam(1e-2), num_steps=300,
        )
        result.best_params, result.history.cost, mg.Stopped[result.stopped]

    One compilation, however many steps and seeds: `jax.random.split(jax.random.key(0), 5)` in place of the key runs
    five seeds in one program. Step number n of a run draws its noise from `fold_in(key, n)`.

    A step whose estimate is not finite is not taken: parameters and optimiser stay as they were, the step is counted in
    `num_skipped`, and the next one draws other noise. Where all samples cost the same and no derivative differs from zero,
    such as where a policy touches nothing, the run stops after a few steps with `Stopped.nothing_felt`.

    With annealing, smoothing decreases as the run converges: `objective` is then a function of a traced scale in
    (0, 1], and `annealing` is the schedule of the scale.

        noisy = mg.parameter_noise(function, stddev=0.3)
        mg.optimise(
            lambda scale: noisy.with_stddev(0.3 * scale), params, key,
            annealing=optax.exponential_decay(1.0, 100, 0.5, end_value=0.05), ...
        )
        # Contact from soft to stiff:
        mg.optimise(
            lambda scale: task.objective(softness=mg.Softness(stiffness=1e3 / scale, damping_ratio=1.0)), params, key,
            annealing=optax.exponential_decay(1.0, 10, 0.5, end_value=0.01), ...
        )

    With a bar of tqdm:

        mg.optimise(..., log=lambda step, metrics: (bar.update(step - bar.n), bar.set_postfix(cost=metrics["cost"])))

    Args:
        objective: what to minimise, or with `annealing` a function from a scale to it.
        params: the start: a vector, with many seeds also one per seed; or a pytree with floating-point arrays, such as a
            dict or an equinox module. The function of `parameter_noise` and `evaluate` then take its form, and the
            result has it. Estimators see all its arrays as one vector.
        key: consumed here; with a leading axis, one per seed.
        estimator: called as `estimator(objective, params, key)`; any of `mg.estimators` with its settings bound by
            `functools.partial`, or your own.
        optimiser: from optax; it is handed the mean cost under noise as `value`, too.
        num_steps: at most.
        annealing: a schedule from step to scale, such as one of optax.
        clip_norm: longest gradient that the optimiser sees; longer ones are shortened to it.
        **options: `evaluate`, `evaluate_every`, `patience`, `log`, `checkpoint`, `checkpoint_every`; see `RunOptions`.

    Returns:
        The last and the best parameters, the history, why it stopped and what was spent.

    Raises:
        ValueError: if `objective` and `annealing` do not belong together, a number is out of range, shapes do not fit,
            or a checkpoint is damaged or of another run.
    """
    vector, restore = flattened(params)
    rule = GradientStep(of_vector(objective, restore), estimator, optimiser, annealing, clip_norm)
    chosen = RunOptions(num_steps, **options)
    if restore is None:
        return run(rule, vector, key, chosen)
    if chosen.evaluate is not None:
        chosen = dataclasses.replace(chosen, evaluate=Restored(chosen.evaluate, restore))
    result = run(rule, vector, key, chosen)
    return dataclasses.replace(result, params=restore(result.params), best_params=restore(result.best_params))


def run(method: Method, params: Float[Array, "..."], key: Key[Array, "..."], options: RunOptions) -> Optimisation:
    """Run a method, from one start or from many at once, one per leading entry of `key`, all in one program."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((method, params, key))):
        raise ValueError(
            "optimise must be called outside of jax.jit and jax.vmap, got a traced value; it compiles itself, and takes several "
            "seeds by several keys"
        )
    params, key = _matched(params, key)
    arrays, static = eqx.partition((method, options), eqx.is_array)
    # Structures name functions: a list of numbers is that of any run of the same program.
    numbers, structure = jax.tree.flatten(arrays)

    def over_seeds(function: Callable, *in_axes: int | None) -> Any:
        def of_numbers(numbers: list[Array], *rest: Any) -> Any:
            return function(static, jax.tree.unflatten(structure, numbers), *rest)

        return jax.jit(jax.vmap(of_numbers, in_axes) if key.ndim else of_numbers)

    carry = compile_once(over_seeds(_start, None, 0).lower(numbers, params))(numbers, params)
    began = time.perf_counter()
    lowered = over_seeds(_segment, None, 0, 0, None).lower(numbers, key, carry, jnp.zeros((), jnp.int32))
    program = _Program(lowered, time.perf_counter() - began)
    nothing = Record.blank(params.dtype), jnp.zeros((), params.dtype)
    saved = Saved(carry, jax.tree.map(lambda x: np.zeros((*key.shape, 0), x.dtype), nothing), np.zeros(0))
    fingerprint = {}
    if options.checkpoint is not None:
        fingerprint = _fingerprint(options, params, key, arrays, lowered)
        if options.checkpoint.exists():
            saved = checkpoint.load(options.checkpoint, saved, fingerprint)

    saved = _loop(functools.partial(program.advance, numbers, key), saved, options, fingerprint)
    finish = compile_once(over_seeds(_finish, None, 0).lower(numbers, saved.carry))
    final_cost, best = finish(numbers, saved.carry)
    history = saved.history()
    return Optimisation(
        params=saved.carry.params,
        best_params=best.params,
        best_cost=best.cost,
        final_cost=final_cost,
        history=history,
        stopped=saved.carry.stopped,
        num_steps=np.asarray(saved.carry.num_steps),
        num_skipped=np.asarray(saved.carry.num_skipped),
        num_rollouts=history.num_rollouts[..., -1],
        num_gradient_rollouts=history.num_gradient_rollouts[..., -1],
        seconds=float(saved.seconds.sum()),
        compile_seconds=program.compile_seconds,
    )


def _loop(advance: Callable[[Saved], Saved], saved: Saved, options: RunOptions, fingerprint: dict[str, Any]) -> Saved:
    """Run segments until every run has stopped."""
    on_disk = saved.seconds.size
    try:
        while np.any(saved.carry.stopped == Stopped.running):
            saved = advance(saved)
            is_due = saved.seconds.size - on_disk >= options.checkpoint_every * options.segment_size
            if options.checkpoint is not None and is_due:
                checkpoint.save(options.checkpoint, saved, fingerprint)
                on_disk = saved.seconds.size
            if options.log is not None:
                options.log(int(np.max(saved.carry.num_steps)), saved.metrics())
    finally:
        # On the way out of an interruption, too: KeyboardInterrupt goes on to the caller.
        if options.checkpoint is not None and saved.seconds.size > on_disk:
            checkpoint.save(options.checkpoint, saved, fingerprint)
    return saved


class _Program:
    """A segment of steps, compiled when it is first run; and what tracing and compiling it took."""

    def __init__(self, lowered: Any, seconds: float):
        self.lowered, self.compiled, self.compile_seconds = lowered, None, seconds

    def advance(self, numbers: list[Array], key: Key[Array, "..."], saved: Saved) -> Saved:
        began = time.perf_counter()
        if self.compiled is None:
            self.compiled = compile_once(self.lowered)
            self.compile_seconds += time.perf_counter() - began
            began = time.perf_counter()
        start = jnp.asarray(saved.seconds.size, jnp.int32)
        carry, trace = jax.block_until_ready(self.compiled(numbers, key, saved.carry, start))
        seconds = time.perf_counter() - began
        done = int(np.max(carry.num_steps)) - int(np.max(saved.carry.num_steps))
        joined = jax.tree.map(lambda old, new: np.concatenate([old, np.asarray(new)], axis=-1), saved.trace, trace)
        # Steps after a stop take no time worth the name.
        spent = np.where(np.arange(trace[1].shape[-1]) < done, seconds / max(done, 1), 0.0)
        return Saved(carry, joined, np.concatenate([saved.seconds, spent]))


def _start(static: PyTree, arrays: PyTree, params: Float[Array, " dim"]) -> Carry:
    method, _ = eqx.combine(arrays, static)
    nan = jnp.full((), jnp.nan, params.dtype)
    zero, stopped = jnp.zeros((), jnp.int32), jax.tree.map(jnp.asarray, Stopped.running)
    return Carry(params, method.init(params), Best(params, nan, nan + jnp.inf, nan), zero, zero, zero, zero, stopped)


def _segment(
    static: PyTree, arrays: PyTree, key: PRNGKeyArray, carry: Carry, start: Int[Array, ""]
) -> tuple[Carry, tuple[Record, Float[Array, " segment"]]]:
    """Take the steps from `start` on; those after the end or after a stop change nothing.

    A segment always has the same length, so that it is compiled once. The number of a step is not part of the carry:
    over many seeds it is then one number, and what happens only at some steps is skipped at the others for all of them.
    """
    method, options = eqx.combine(arrays, static)
    nan = jnp.full((), jnp.nan, carry.params.dtype)
    evaluate = options.evaluate or (lambda _: nan)

    def idle(params: Float[Array, " dim"], state: PyTree, *_: Any) -> tuple[Float[Array, " dim"], PyTree, Record]:
        return params, state, Record.blank(params.dtype)

    def step(carry: Carry, index: Int[Array, ""]) -> tuple[Carry, tuple[Record, Float[Array, ""]]]:
        at, is_running, is_left = carry.params, carry.stopped == Stopped.running, index < options.num_steps
        # Apart, for over many seeds the end is the same for all, whereas some may have stopped.
        if_running = functools.partial(jax.lax.cond, is_running)
        # `cond` asks for a hash, which a method of traced arrays has none of.
        advance = functools.partial(if_running, functools.partial(method.advance), idle)
        own_key = jax.random.fold_in(key, index)
        params, state, record = jax.lax.cond(is_left, advance, idle, at, carry.state, own_key, index)
        measured = functools.partial(if_running, lambda x: jnp.asarray(evaluate(x), x.dtype), lambda _: nan)
        is_due = is_left & (index % options.evaluate_every == 0)
        noise_free = jax.lax.cond(is_due, measured, lambda _: nan, at)
        under_noise = Best(at, record.cost, record.scale, record.finite_fraction)
        moved = Carry(
            params=params,
            state=state,
            best=carry.best.against(under_noise if options.evaluate is None else Best.measured(at, noise_free)),
            num_steps=carry.num_steps + 1,
            num_skipped=carry.num_skipped + ~record.is_taken,
            num_in_a_row=jnp.where(record.is_taken, 0, carry.num_in_a_row + 1),
            num_still=jnp.where(record.reason == Reason.nothing_felt, carry.num_still + 1, 0),
            stopped=carry.stopped,
        )
        moved = dataclasses.replace(moved, stopped=_stopped(options, moved, record, index))
        is_stepping = is_left & is_running
        return jax.tree.map(lambda new, old: jnp.where(is_stepping, new, old), moved, carry), (record, noise_free)

    return jax.lax.scan(step, carry, start + jnp.arange(options.segment_size, dtype=jnp.int32))


def _stopped(options: RunOptions, carry: Carry, record: Record, index: Int[Array, ""]) -> Stopped:
    """Say why a run stops after a step, if it does; the weightiest reason comes last."""
    stopped = Stopped.where(index + 1 >= options.num_steps, Stopped.finished, Stopped.running)
    enough = jnp.where(record.step_norm == 0, min(STILL_STEPS, options.patience), options.patience)
    stopped = Stopped.where(carry.num_still >= enough, Stopped.nothing_felt, stopped)
    return Stopped.where(carry.num_in_a_row >= options.patience, Stopped.not_finite, stopped)


def _finish(static: PyTree, arrays: PyTree, carry: Carry) -> tuple[Float[Array, ""], Best]:
    """Evaluate the last point, and let it compete with the best before."""
    evaluate, params = eqx.combine(arrays, static)[1].evaluate, carry.params
    if evaluate is None:
        return jnp.full((), jnp.nan, params.dtype), carry.best
    cost = jnp.asarray(evaluate(params), params.dtype)
    return cost, carry.best.against(Best.measured(params, cost))


def _fingerprint(
    options: RunOptions, params: Float[Array, "..."], key: Key[Array, "..."], arrays: PyTree, lowered: Any
) -> dict[str, Any]:
    """Say what a resumed run must have in common with this one: the program itself, and all that it is given."""
    return {
        **{name: getattr(options, name) for name in ("num_steps", "evaluate_every", "patience")},
        "shape": list(params.shape),
        "dtype": str(params.dtype),
        "start": checkpoint.digest((params, key)),
        "arrays": checkpoint.digest(arrays),
        # The lowered program has every number in it that is not an argument, such as a learning rate.
        "program": checkpoint.digest(np.frombuffer(lowered.as_text().encode(), np.uint8)),
    }


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
            "use jnp.atleast_1d for one number, objective.ravel for controls"
        )
    return jnp.broadcast_to(params, (*key.shape, params.shape[-1])), key
