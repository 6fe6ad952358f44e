"""The device that a program is for, and batches split over several devices. No other module asks for the device.

A CPU runs operations along the batch and handles loops well; a GPU spends a microsecond on starting any operation. So several
parts of the library have two implementations and choose one here. XLA leaves the second core of a CPU idle most of the time: as
two devices (`jax.config.update("jax_num_cpu_devices", 2)` before JAX is used) the cores work in parallel by `over_devices`.
"""

import functools
import math
import os
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import mlir

from mjxgrad._arrays import whole


def is_cpu() -> bool:
    """Return whether programs run on a CPU unless they are placed elsewhere."""
    return jax.default_backend() == "cpu"


def is_gpu() -> bool:
    """Return whether programs run on a GPU unless they are placed elsewhere."""
    return jax.default_backend() == "gpu"


def all_devices() -> list[jax.Device]:
    """Return the devices of all processes."""
    return jax.devices()


def own_device() -> jax.Device:
    """Return the first device of this process; each process has devices of its own."""
    return jax.local_devices()[0]


def fits(what: str, size: int | float, remedy: str, *, is_on_host: bool = False) -> None:
    """Refuse what takes more bytes than its device has, before they are asked for; a size is a lower bound."""
    there = None if is_on_host else (own_device().memory_stats() or {}).get("bytes_limit")
    there = there or (os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else math.inf)
    if size > there:
        raise ValueError(f"{what} would take {size / 2**30:.3g} GiB, and there are {there / 2**30:.3g}: {remedy}")


def copies(value: Any) -> int:
    """Return how many of a traced value `jax.vmap` makes; 1 for others."""
    most, inner = np.size(value), value  # the same, or what `jax.vmap` hides in it
    while isinstance(inner, jax.core.Tracer):
        most, inner = max(most, np.size(inner)), getattr(inner, "val", 0)
    return max(1, most // max(1, np.size(value)))


def by_platform(*args: Any, gpu: Callable[..., Any], default: Callable[..., Any]) -> Any:
    """Return a function's result on NVIDIA's GPUs and another's elsewhere, chosen when the program is compiled."""
    return jax.lax.platform_dependent(*args, cuda=gpu, default=default)


def set_lowerings(primitive: Primitive, *, default: Callable, cpu: Callable, gpu: Callable) -> None:
    """Set the implementations of a primitive: on a single CPU device, on a GPU, and elsewhere."""

    def on_cpu(context: mlir.LoweringRuleContext, *factors, **parameters):
        way = default if _is_shared_out(context) else cpu
        return mlir.lower_fun(way, multiple_results=False)(context, *factors, **parameters)

    mlir.register_lowering(primitive, mlir.lower_fun(default, multiple_results=False))
    mlir.register_lowering(primitive, on_cpu, platform="cpu")
    mlir.register_lowering(primitive, mlir.lower_fun(gpu, multiple_results=False), platform="cuda")


def _is_shared_out(context: mlir.LoweringRuleContext) -> bool:
    """Return whether XLA partitions the program over devices; it would gather every array with a layout constraint."""
    axes = context.module_context.axis_context
    if hasattr(axes, "mesh"):  # in `jax.shard_map`, which partitions by its manual axes itself
        return any(size > 1 for name, size in axes.mesh.shape.items() if name not in axes.manual_axes)
    return getattr(axes, "num_devices", 1) > 1


def over_devices(function: Callable[..., Any], *, num_shared: int = 0) -> Callable[..., Any]:
    """Return `jax.vmap(function)` whose batch is split evenly over all devices of the default platform.

    The devices exchange nothing. With one device the result is `jax.vmap(function)`. The arguments are pytrees of arrays with
    the batch as leading axis; all members share the first `num_shared` of them, which have none.

    Raises:
        ValueError: when called with arguments without a common leading axis, or with one that the devices do not divide.
    """
    if not callable(function):
        raise ValueError(f"function must be a function of arrays, got {type(function).__name__}")
    num_shared = whole("num_shared", num_shared, 0)

    @functools.wraps(function)
    def wrapped(*args: Any) -> Any:
        batched = jax.vmap(function, in_axes=tuple(None if i < num_shared else 0 for i in range(len(args))))
        own = all_devices()
        sizes = {np.shape(x)[:1] for x in jax.tree.leaves(args[num_shared:])}
        if len(sizes) != 1 or sizes == {()}:
            given = f"leading axes of {sorted(sizes)}" if sizes else "none that is not shared"
            raise ValueError(
                f"arguments that are not shared must have the batch as leading axis, of one size, got {given}"
            )
        if len(own) == 1:
            return batched(*args)
        ((size,),) = sizes
        if size % len(own):
            raise ValueError(f"the batch must be a multiple of the {len(own)} devices, got {size}")
        mesh, part = jax.sharding.Mesh(np.array(own), ("batch",)), jax.sharding.PartitionSpec("batch")
        specs = tuple(jax.sharding.PartitionSpec() if i < num_shared else part for i in range(len(args)))
        # XLA's partitioner crashes on empty inputs that are used (jax 0.11.2), so each device makes its own.
        given, empty = eqx.partition(args, lambda x: np.size(x) > 0)

        def of_part(*given: Any) -> Any:
            made = []
            for i, one in enumerate(empty):
                count = 1 if i < num_shared else len(own)
                zeros = lambda x, count=count: jnp.zeros((len(x) // count, *x.shape[1:]), x.dtype)  # noqa: E731
                made.append(jax.tree.map(zeros, one))
            return jax.jit(batched)(*eqx.combine(given, tuple(made)))

        return jax.shard_map(of_part, mesh=mesh, in_specs=specs, out_specs=part, check_vma=False)(*given)

    return wrapped
