"""The loop that every method runs in: steps on the device in segments; logs and checkpoints between them.

A method is two functions, from a start to a carry and from a carry to the next; the carry is any pytree.
"""

import functools
import hashlib
import io
import json
import math
import time
import zipfile
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

from mjxgrad._arrays import function, instance
from mjxgrad._programs import compile_once
from mjxgrad._text import write
from mjxgrad.batched.device import all_devices

Log = Callable[[int, dict[str, float]], Any]
_FORMAT = 3  # of checkpoints
_PARTS = {
    "program": "the code of environment, objective, estimator, optimiser, method or versions of the libraries",
    "arrays": "arrays in environment, objective or method",
    "start": "params or key",
}


class Progress(NamedTuple):
    """The state and the records of a run so far."""

    carry: PyTree  # after the last step
    found: PyTree  # records of the steps, in NumPy, with the steps on the first axis
    # Wall-clock time of each step, without compilation, measured per segment and divided among its steps.
    seconds: Float[np.ndarray, " steps"]
    compile_seconds: float = 0.0  # time of tracing and compilation in this session

    @property
    def num_steps(self) -> int:
        return self.seconds.size


class Method(eqx.Module):
    """A method that the loop repeats; `init` and `step` are needed, the others have a default.

    Its arrays are arguments of the compiled program, so a method with other numbers needs no new compilation.
    """

    @abstractmethod
    def init(self, start: PyTree) -> PyTree:
        """Return the carry before the first step, with everything that a step needs, random keys included."""

    @abstractmethod
    def step(self, carry: PyTree, index: Int[Array, ""]) -> tuple[PyTree, PyTree]:
        """Take the step of this number; return the carry after it, and its record, a dict if a log is kept."""

    def is_over(self, carry: PyTree) -> Bool[Array, "..."] | bool:
        """Return whether a run has ended before its last step; of many runs, for each."""
        return False

    def identity(self) -> dict[str, Any]:
        """Return named values that a resumed run must share, besides the program, the start and `shared`."""
        return {}

    def shared(self) -> PyTree:
        """Return what arrays of the method a resumed run must share; by default all."""
        return self

    def metrics(self, progress: Progress, count: int) -> dict[str, float]:
        """Return the values for a log: the means of the finite records over the last `count` steps."""
        found = progress.found | {"seconds": progress.seconds}
        return {name: mean(values[-count:]) for name, values in found.items()}

    def result(self, progress: Progress) -> Any:
        """Return the result of the run for its caller."""
        return progress


def side_by_side(methods: Sequence[Any]) -> tuple[Any, list[int | None]]:
    """Return methods that differ only in numbers as one method, and the axis of each of its arrays over the methods.

    Arrays that differ are stacked along their first axis. Arrays that all methods share are not copied; their axis is None.

    Raises:
        ValueError: if the methods differ in more than numbers.
    """
    parts = [eqx.partition(one, eqx.is_array) for one in methods]
    if not all(eqx.tree_equal(parts[0][1], other) for _, other in parts):
        raise ValueError("methods side by side must differ in numbers alone; run each separately")
    numbers = list(zip(*(jax.tree.leaves(arrays) for arrays, _ in parts), strict=True))
    is_common = [len(set(map(_digest, each))) == 1 for each in numbers]
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
    checkpoint: str | Path | None = None,
    on_all_devices: bool = False,
) -> Any:
    """Repeat a method until it is over, and return its `result`.

    Args:
        method: the method.
        start: argument of the method's `init`.
        num_steps: largest number of steps.
        segment: steps in one program; logs and checkpoints come between segments.
        over: axes of the method's arrays for each leading axis of the start: None for many starts of one method, else the
            list from `side_by_side`. All runs are in one program.
        log: function called after every segment with the number of steps done and the method's `metrics`.
        checkpoint: file to save the run in after every segment, and to resume it from.
        on_all_devices: whether all devices of all processes get the arrays, for a method that spreads its work over them.

    Raises:
        ValueError: if the checkpoint has no folder, is damaged, or from a run with another program, arrays or start.
    """
    function("log", log, "step", "metrics")
    instance("checkpoint", checkpoint, str | Path | None, "the path of a file")
    checkpoint = None if checkpoint is None else Path(checkpoint)
    if checkpoint is not None and not checkpoint.parent.is_dir():
        raise ValueError(
            f"checkpoint must be in a folder that exists, got {checkpoint}; make {checkpoint.parent} first"
        )
    arrays, static = eqx.partition(method, eqx.is_array)
    # A list, since the structure holds functions: runs of one program then have arguments of equal structure.
    numbers, structure = jax.tree.flatten(arrays)
    sharding = _everywhere() if on_all_devices else None
    numbers, start = _placed((numbers, start), sharding)

    def init(numbers: list[Array], start: PyTree) -> PyTree:
        return eqx.combine(jax.tree.unflatten(structure, numbers), static).init(start)

    def step(numbers: list[Array], carry: PyTree, index: Int[Array, ""]) -> tuple[PyTree, PyTree]:
        return eqx.combine(jax.tree.unflatten(structure, numbers), static).step(carry, index)

    for axes in reversed(over):
        # The step number is not mapped: a `lax.cond` on it stays a branch instead of computing both sides.
        init, step = jax.vmap(init, (axes, 0)), jax.vmap(step, (axes, 0, None))
    carry = compile_once(jax.jit(init, out_shardings=sharding).lower(numbers, start))(numbers, start)
    # Traced once for the shapes of the records, for the text of the program, and for the segment.
    began, step = time.perf_counter(), jax.jit(step)
    traced = step.trace(numbers, carry, np.int32(0))
    steps = jax.jit(_steps(step, traced.out_info[1], method.is_over, segment), out_shardings=sharding)
    nothing = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), traced.out_info[1])
    progress = Progress(carry, nothing, np.zeros(0), time.perf_counter() - began)
    identity = {}
    if checkpoint is not None:
        # Classes of one name may differ in code. The lowered program has every number that is no argument, such as a rate.
        text = np.frombuffer(traced.lower().as_text().encode(), np.uint8)
        parts = {"start": start, "arrays": eqx.filter(method.shared(), eqx.is_array), "program": text}
        identity = method.identity() | {name: _digest(part) for name, part in parts.items()}
    if checkpoint is not None and checkpoint.exists():
        carry, found, seconds = _load(checkpoint, progress[:3], identity)
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
            if checkpoint is not None and is_first:
                _save(checkpoint, progress[:3], identity)
                on_disk = progress.num_steps
            if log is not None and is_first:
                log(progress.num_steps, method.metrics(progress, progress.num_steps - done))
    finally:
        # Also after an interruption of a save: KeyboardInterrupt goes on to the caller.
        if checkpoint is not None and is_first and progress.num_steps > on_disk:
            _save(checkpoint, progress[:3], identity)
    return method.result(progress)


def mean(values: Shaped[np.ndarray, "..."]) -> float:
    """Return the mean of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _after(progress: Progress, program: Callable[[], tuple[Array, PyTree, PyTree]]) -> Progress:
    """Run a segment and return the progress with its records appended."""
    began = time.perf_counter()
    reached, carry, rows = jax.block_until_ready(program())
    count = int(reached) - progress.num_steps
    new = rows, np.full(count, (time.perf_counter() - began) / count)
    found, seconds = jax.tree.map(lambda old, new: np.concatenate([old, np.asarray(new)[:count]]), progress[1:3], new)
    return Progress(carry, found, seconds, progress.compile_seconds)


def _steps(step: Callable, found: PyTree, is_over: Callable, segment: int) -> Callable:
    """Return the program of a segment: steps up to a given number, fewer if all runs are over before."""

    def steps(numbers: list[Array], carry: PyTree, first: Array, end: Array) -> tuple[Array, PyTree, PyTree]:
        def is_going(now: tuple[Array, PyTree, PyTree]) -> Bool[Array, ""]:
            return (now[0] < end) & ~jnp.all(is_over(now[1]))

        def advance(now: tuple[Array, PyTree, PyTree]) -> tuple[Array, PyTree, PyTree]:
            index, carry, rows = now
            carry, row = step(numbers, carry, index)
            put = functools.partial(jax.lax.dynamic_update_index_in_dim, index=index - first, axis=0)
            return index + 1, carry, jax.tree.map(put, rows, row)

        # A while_loop can end early but stacks no outputs, so the records are written into arrays of full length.
        rows = jax.tree.map(lambda x: jnp.zeros((segment, *x.shape), x.dtype), found)
        return jax.lax.while_loop(is_going, advance, (first, carry, rows))

    return steps


def _everywhere() -> jax.sharding.Sharding | None:
    """Return the sharding that replicates arrays on all devices of all processes; None for a single device."""
    devices = all_devices()
    if len(devices) == 1:
        return None
    if jax.process_count() > 1:
        # Synchronise before compiling: compilation times may differ by more than the deadline for connecting.
        sync_global_devices("loop")
    return jax.sharding.NamedSharding(jax.sharding.Mesh(np.array(devices), ("batch",)), jax.sharding.PartitionSpec())


def _placed(tree: PyTree, sharding: jax.sharding.Sharding | None) -> PyTree:
    """Return the arrays placed by a sharding; unchanged if it is None."""
    if sharding is None:
        return tree
    # From the host: arrays on a device cannot always be sent to another process.
    return jax.tree.map(lambda x: _restored(jax.device_put(_as_numpy(x), sharding), x), tree)


def _save(path: Path, tree: PyTree, fingerprint: dict[str, Any]) -> None:
    """Write a pytree of arrays atomically: an interruption leaves the former file intact."""
    leaves = {f"leaf{i}": _as_numpy(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
    header = json.dumps({"format": _FORMAT, **fingerprint}).encode()
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, header=np.frombuffer(header, np.uint8), **leaves)
    write(path, content.getvalue())


def _load(path: Path, like: PyTree, fingerprint: dict[str, Any]) -> PyTree:
    """Return the pytree that `_save` wrote, with the structure and types of `like`; refuse damaged files and other runs."""
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no archive of arrays")
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(archive["header"].tobytes())
            leaves = [archive[f"leaf{i}"] for i in range(len(archive.files) - 1)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"checkpoint must be a file that a run has saved, got {path}, which cannot be read ({error}); "
            "delete it to begin anew"
        ) from error
    expected = {"format": _FORMAT, **fingerprint}
    differing = {name: value for name, value in expected.items() if header.get(name) != value}
    if differing:
        changes = [_PARTS.get(name, f"{name} was {header.get(name)} and is {here}") for name, here in differing.items()]
        raise ValueError(
            f"checkpoint must be of the same run, got {path} of one with other settings: {', '.join(changes)}; "
            "use the settings of that run, or another path"
        )
    wanted = jax.tree.leaves(like)
    return jax.tree.unflatten(jax.tree.structure(like), [_restored(x, y) for x, y in zip(leaves, wanted, strict=True)])


def _digest(tree: PyTree) -> str:
    """Return a short hash of the content of arrays."""
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = _as_numpy(leaf)
        sha.update(f"{array.dtype}{array.shape}".encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()[:16]


def _as_numpy(leaf: Any) -> np.ndarray:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def _restored(saved: np.ndarray | Array, like: Any) -> Any:
    if isinstance(like, jax.Array) and jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(saved), impl=jax.random.key_impl(like))
    if saved.dtype.kind == "V":  # NumPy's format has no name for bfloat16 and its like
        saved = saved.view(np.asarray(like).dtype)
    return saved if isinstance(like, np.ndarray) else jnp.asarray(saved)
