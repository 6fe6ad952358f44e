"""The loop that every method runs in: steps on the device in segments; logs and checkpoints between them.

A method is two functions, from a start to a carry and from a carry to the next, and the carry is any pytree. Descents (`descent`)
are methods with a vector of parameters; policies are learned by one, too (`mjxgrad.learning`).
"""

import functools
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import sync_global_devices
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from mjxgrad._programs import compile_once
from mjxgrad.batched.device import all_devices
from mjxgrad.loop import checkpoint as checkpoints

Log = Callable[[int, dict[str, float]], Any]


class Progress(NamedTuple):
    """A run so far: all that it needs to go on, and what it found.

    Attributes:
        carry: after the last step.
        found: what the steps returned besides, in NumPy, with the steps on the first axis.
        seconds: of the clock for each step. They are measured by segment and divided evenly among its steps.
        compile_seconds: of tracing and compilation in this session.
    """

    carry: PyTree
    found: PyTree
    seconds: Float[np.ndarray, " steps"]
    compile_seconds: float = 0.0

    @property
    def num_steps(self) -> int:
        return self.seconds.size


class Method(eqx.Module):
    """What the loop repeats; `init` and `step` are needed, the others have a default.

    Its arrays are arguments of the compiled program, so that a method with other numbers compiles nothing.
    """

    @abstractmethod
    def init(self, start: PyTree) -> PyTree:
        """Return the carry before the first step: all that a step needs, random keys too."""

    @abstractmethod
    def step(self, carry: PyTree, index: Int[Array, ""]) -> tuple[PyTree, PyTree]:
        """Take the step of this number; return the carry after it, and what is to be kept of every step."""

    def is_over(self, carry: PyTree) -> Bool[Array, "..."] | bool:
        """Say whether a run has ended before the number of its steps; of many, for each."""
        return False

    def identity(self) -> dict[str, Any]:
        """Return what a resumed run must share by name, besides the program, the arrays and the start."""
        return {}

    def metrics(self, progress: Progress, count: int) -> dict[str, float]:
        """Return what a log is told: the means over the last steps, so many, of what is a number."""
        found = progress.found | {"seconds": progress.seconds}
        return {name: mean(values[-count:]) for name, values in found.items()}

    def result(self, progress: Progress) -> Any:
        """Return what the caller of the run gets."""
        return progress


def side_by_side(methods: Sequence[Any]) -> tuple[Any, list[int | None]]:
    """Return methods that differ in numbers alone as one, and which axis of each of its arrays goes through them.

    Arrays that all share are not copied for each and have none; the others are stacked along their first.

    Raises:
        ValueError: if they differ in more than numbers.
    """
    parts = [eqx.partition(one, eqx.is_array) for one in methods]
    if not all(eqx.tree_equal(parts[0][1], other) for _, other in parts):
        raise ValueError("what runs side by side must differ in numbers alone: run each by itself")
    numbers = list(zip(*(jax.tree.leaves(arrays) for arrays, _ in parts), strict=True))
    is_common = [len(set(map(checkpoints.digest, each))) == 1 for each in numbers]
    joined = [each[0] if same else jnp.stack(each) for each, same in zip(numbers, is_common, strict=True)]
    arrays = jax.tree.unflatten(jax.tree.structure(parts[0][0]), joined)
    return eqx.combine(arrays, parts[0][1]), [None if same else 0 for same in is_common]


def run(
    method: Method,
    start: PyTree,
    *,
    num_steps: int,
    segment: int,
    over: Sequence[list[int | None] | None] = (),
    log: Log | None = None,
    checkpoint: Path | None = None,
    checkpoint_every: int = 1,
    on_all_devices: bool = False,
) -> Any:
    """Repeat a method until it is over, and return what its `result` makes of that.

    Args:
        method: what to repeat.
        start: what its `init` takes.
        num_steps: at most.
        segment: steps in one program; between two of them are logs and checkpoints.
        over: for each leading axis that the start has, how arrays of the method go along: None for many starts of one method, or
            as `side_by_side` says. All run in one program.
        log: called after every segment with the number of steps done and the method's `metrics`.
        checkpoint: file to save the run in, and to resume it from as if it had never stopped.
        checkpoint_every: segments between two saves. An interrupted run is saved in any case.
        on_all_devices: whether all devices of all processes get the arrays, for a method that spreads its work over them.

    Raises:
        ValueError: if the checkpoint is damaged, or of a run with another program, other arrays or another start.
    """
    arrays, static = eqx.partition(method, eqx.is_array)
    # Structures name functions: a list of numbers is that of any run of the same program.
    numbers, structure = jax.tree.flatten(arrays)
    sharding = _everywhere() if on_all_devices else None
    numbers, start = _placed((numbers, start), sharding)

    def init(numbers: list[Array], start: PyTree) -> PyTree:
        return eqx.combine(jax.tree.unflatten(structure, numbers), static).init(start)

    def step(numbers: list[Array], carry: PyTree, index: Int[Array, ""]) -> tuple[PyTree, PyTree]:
        return eqx.combine(jax.tree.unflatten(structure, numbers), static).step(carry, index)

    for axes in reversed(over):
        # The number of a step is one for all: what is done at some steps is skipped at the others for all of them.
        init, step = jax.vmap(init, (axes, 0)), jax.vmap(step, (axes, 0, None))
    carry = compile_once(jax.jit(init, out_shardings=sharding).lower(numbers, start))(numbers, start)
    # Traced once: for the shapes of what is found, for the text of the program, and within a segment of steps.
    began, step = time.perf_counter(), jax.jit(step)
    traced = step.trace(numbers, carry, np.int32(0))
    steps = jax.jit(_steps(step, traced.out_info[1], method.is_over, segment), out_shardings=sharding)
    nothing = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), traced.out_info[1])
    progress = Progress(carry, nothing, np.zeros(0), time.perf_counter() - began)
    identity = {} if checkpoint is None else _identity(method, start, numbers, traced.lower().as_text())
    if checkpoint is not None and checkpoint.exists():
        carry, found, seconds = checkpoints.load(checkpoint, progress[:3], identity)
        progress = Progress(_placed(carry, sharding), found, seconds, progress.compile_seconds)
    on_disk, compiled, is_first = progress.num_steps, None, jax.process_index() == 0
    try:
        while (done := progress.num_steps) < num_steps and not np.all(method.is_over(progress.carry)):
            given = numbers, progress.carry, np.int32(done), np.int32(min(done + segment, num_steps))
            if compiled is None:
                began = time.perf_counter()
                compiled = compile_once(steps.lower(*given))
                progress = progress._replace(compile_seconds=progress.compile_seconds + time.perf_counter() - began)
            progress = _after(progress, functools.partial(compiled, *given))
            if checkpoint is not None and is_first and progress.num_steps - on_disk >= checkpoint_every * segment:
                checkpoints.save(checkpoint, progress[:3], identity)
                on_disk = progress.num_steps
            if log is not None and is_first:
                log(progress.num_steps, method.metrics(progress, progress.num_steps - done))
    finally:
        # On the way out of an interruption, too: KeyboardInterrupt goes on to the caller.
        if checkpoint is not None and is_first and progress.num_steps > on_disk:
            checkpoints.save(checkpoint, progress[:3], identity)
    return method.result(progress)


def _identity(method: Method, start: PyTree, numbers: list[Array], program: str) -> dict[str, Any]:
    """Say what a resumed run must have in common with this one; a class of the same name may have other code."""
    return {
        **method.identity(),
        "start": checkpoints.digest(start),
        "arrays": checkpoints.digest(numbers),
        # The lowered program has every number in it that is not an argument, such as a learning rate.
        "program": checkpoints.digest(np.frombuffer(program.encode(), np.uint8)),
    }


def mean(values: Shaped[np.ndarray, "..."]) -> float:
    """Return the mean of what is finite; NaN if nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _after(progress: Progress, program: Callable[[], tuple[Array, PyTree, PyTree]]) -> Progress:
    """Run a segment and join what it found."""
    began = time.perf_counter()
    reached, carry, rows = jax.block_until_ready(program())
    count = int(reached) - progress.num_steps
    new = rows, np.full(count, (time.perf_counter() - began) / count)
    found, seconds = jax.tree.map(lambda old, new: np.concatenate([old, np.asarray(new)[:count]]), progress[1:3], new)
    return Progress(carry, found, seconds, progress.compile_seconds)


def _steps(step: Callable, found: PyTree, is_over: Callable, segment: int) -> Callable:
    """Return the program of a segment: steps up to a number that is an argument, fewer where all is over before."""

    def steps(numbers: list[Array], carry: PyTree, first: Array, end: Array) -> tuple[Array, PyTree, PyTree]:
        def is_going(now: tuple[Array, PyTree, PyTree]) -> Bool[Array, ""]:
            return (now[0] < end) & ~jnp.all(is_over(now[1]))

        def advance(now: tuple[Array, PyTree, PyTree]) -> tuple[Array, PyTree, PyTree]:
            index, carry, rows = now
            carry, row = step(numbers, carry, index)
            put = functools.partial(jax.lax.dynamic_update_index_in_dim, index=index - first, axis=0)
            return index + 1, carry, jax.tree.map(put, rows, row)

        rows = jax.tree.map(lambda x: jnp.zeros((segment, *x.shape), x.dtype), found)
        return jax.lax.while_loop(is_going, advance, (first, carry, rows))

    return steps


def _everywhere() -> jax.sharding.Sharding | None:
    """Return the sharding of arrays that all devices of all processes are to have; None where there is one device."""
    devices = all_devices()
    if len(devices) == 1:
        return None
    if jax.process_count() > 1:
        # Meet before compiling: by how much that differs in time can exceed the deadline for connecting.
        sync_global_devices("loop")
    return jax.sharding.NamedSharding(jax.sharding.Mesh(np.array(devices), ("batch",)), jax.sharding.PartitionSpec())


def _placed(tree: PyTree, sharding: jax.sharding.Sharding | None) -> PyTree:
    """Put arrays where a sharding says."""

    def put(x: Array) -> Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(jax.random.key_data(x)), impl=jax.random.key_impl(x))
        # From the host: what one process has on a device others cannot always be sent.
        return jax.device_put(np.asarray(x), sharding)

    return tree if sharding is None else jax.tree.map(put, tree)
