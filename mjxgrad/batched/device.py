"""Which device a program is for, and a batch shared out over several: the one place of the library that asks.

A processor runs operations along the batch and likes loops; a GPU spends a microsecond on starting an operation, however short.
So several parts have two ways, and ask here which of them to take.

XLA runs one small operation after another, and a processor's second core idles most of that time. As two devices
(`jax.config.update("jax_num_cpu_devices", 2)` before JAX is used, or `XLA_FLAGS=--xla_force_host_platform_device_count=2`)
the cores work side by side, and wait for the slowest member of half the batch, not of all. With several GPUs the same call uses
them all.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import mlir


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
    """Return the first device of this process: of several processes each has its own."""
    return jax.local_devices()[0]


def by_platform(*args: Any, gpu: Callable[..., Any], default: Callable[..., Any]) -> Any:
    """Call one function on NVIDIA's GPUs and another elsewhere: a program may yet be compiled for the CPU beside the GPU."""
    return jax.lax.platform_dependent(*args, cuda=gpu, default=default)


def set_lowerings(primitive: Primitive, *, default: Callable, cpu: Callable, gpu: Callable) -> None:
    """Set what a primitive is compiled to: on a CPU that shares the program with no other device, on a GPU, and elsewhere."""

    def on_cpu(context: mlir.LoweringRuleContext, *factors, **parameters):
        way = default if _is_shared_out(context) else cpu
        return mlir.lower_fun(way, multiple_results=False)(context, *factors, **parameters)

    mlir.register_lowering(primitive, mlir.lower_fun(default, multiple_results=False))
    mlir.register_lowering(primitive, on_cpu, platform="cpu")
    mlir.register_lowering(primitive, mlir.lower_fun(gpu, multiple_results=False), platform="cuda")


def _is_shared_out(context: mlir.LoweringRuleContext) -> bool:
    """Return whether XLA shares out the program over devices: it would gather all that asks for a layout."""
    axes = context.module_context.axis_context
    if hasattr(axes, "mesh"):  # in `jax.shard_map`, which shares out by some axes itself
        return any(size > 1 for name, size in axes.mesh.shape.items() if name not in axes.manual_axes)
    return getattr(axes, "num_devices", 1) > 1


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
        own = all_devices() if devices is None else list(devices)
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
