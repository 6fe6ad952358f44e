"""A batch split over devices, each of which works on its part alone; and compiled programs kept from one process to the next.

XLA runs one small operation after another, and a processor's second core idles most of that time. As two devices
(`jax.config.update("jax_num_cpu_devices", 2)` before JAX is used, or `XLA_FLAGS=--xla_force_host_platform_device_count=2`)
the cores work side by side, and wait for the slowest member of half the batch, not of all. With several GPUs the same call uses
them all.
"""

import functools
import hashlib
import importlib.metadata
import os
import platform
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def over_devices(
    function: Callable[..., Any], devices: Sequence[jax.Device] | None = None, *, num_shared: int = 0
) -> Callable[..., Any]:
    """Return `jax.vmap(function)` whose batch is split evenly over devices.

    Nothing is exchanged between them. With one device it is `jax.vmap(function)`.

    Args:
        function: of one member of the batch; its arguments are pytrees of arrays that have the batch as leading axis.
        devices: all of the default platform, if none are named.
        num_shared: how many of the first arguments all members share; they have no such axis.

    Raises:
        ValueError: when called with arguments without one common leading axis, or one that the devices do not divide.
    """

    @functools.wraps(function)
    def wrapped(*args: Any) -> Any:
        batched = jax.vmap(function, in_axes=tuple(None if i < num_shared else 0 for i in range(len(args))))
        own = jax.devices() if devices is None else list(devices)
        if len(own) == 1:
            return batched(*args)
        sizes = {np.shape(x)[:1] for x in jax.tree.leaves(args[num_shared:])}
        if len(sizes) != 1 or sizes == {()}:
            raise ValueError("all arguments that are not shared must have the batch as leading axis, of one size")
        ((size,),) = sizes
        if size % len(own):
            raise ValueError(f"the batch must be a multiple of the {len(own)} devices, got {size}")
        mesh = jax.sharding.Mesh(np.array(own), ("batch",))
        leaves, structure = jax.tree.flatten(args)
        num_whole = len(jax.tree.leaves(args[:num_shared]))
        specs = [jax.sharding.PartitionSpec(*() if i < num_whole else ("batch",)) for i in range(len(leaves))]
        # XLA's partitioner crashes on inputs without a number that are used (jax 0.11.2): each device makes its own. Compiled as
        # one, what the function closes over is no input.
        empty = {
            i: x.shape if i < num_whole else (size // len(own), *x.shape[1:])
            for i, x in enumerate(leaves)
            if not np.size(x)
        }

        def of_part(given: list[Any]) -> Any:
            numbers = iter(given)
            parts = [jnp.zeros(empty[i], x.dtype) if i in empty else next(numbers) for i, x in enumerate(leaves)]
            return jax.jit(batched)(*jax.tree.unflatten(structure, parts))

        given, specs = ([x for i, x in enumerate(xs) if i not in empty] for xs in (leaves, specs))
        part = jax.sharding.PartitionSpec("batch")
        return jax.shard_map(of_part, mesh=mesh, in_specs=(specs,), out_specs=part, check_vma=False)(given)

    return wrapped


def keep_compiled() -> Path | None:
    """Keep compiled programs in the user's folder of caches, for the next process. Call it before anything is computed.

    It sets JAX's global `jax_compilation_cache_dir`, unless that is set already. Programs hold for one processor and one jaxlib,
    so each of them has a folder of its own. Nothing removes old programs; the folder may be deleted at any time.

    Returns:
        The folder in use; None if it cannot be written, and nothing is kept.
    """
    if present := jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return Path(present)
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute()
        place = caches / "mjxgrad" / f"jaxlib-{importlib.metadata.version('jaxlib')}-{_processor()}"
        place.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # read-only, or there is no home
        return None
    if not os.access(place, os.W_OK):
        return None
    found = {"compilation_cache_dir": str(place), "persistent_cache_min_compile_time_secs": 0.0}
    for name, value in (found | {"persistent_cache_min_entry_size_bytes": -1}).items():
        jax.config.update(f"jax_{name}", value)
    warnings.showwarning = functools.partial(_show, warnings.showwarning, place, [])
    return place


def _show(show: Callable[..., None], place: Path, told: list[Any], message: Any, *args: Any, **kwargs: Any) -> None:
    """Show a warning; of JAX's for each program that cannot be read or written, dozens with one cause, one in their place."""
    if "persistent compilation cache" in str(message):
        told.append(message)
        message = UserWarning(f"programs in {place} cannot be read or written and are compiled again; delete it")
    if len(told) < 2 or not str(message).startswith("programs in"):
        show(message, *args, **kwargs)


def _processor() -> str:
    """Return a short name of what programs are compiled for: the processor with all that it can do."""
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.is_file() else [platform.processor()]
    kinds = sorted(
        {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))} or lines[:1]
    )
    return f"{platform.machine()}-{hashlib.sha256(''.join(kinds).encode()).hexdigest()[:8]}"
