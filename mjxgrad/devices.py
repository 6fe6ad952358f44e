"""A batch split over devices, each of which works on its part alone.

XLA runs one small operation after another, and a processor's second core idles most of that time. As two devices
(`jax.config.update("jax_num_cpu_devices", 2)` before JAX is used, or `XLA_FLAGS=--xla_force_host_platform_device_count=2`)
the cores work side by side, and wait for the slowest member of half the batch, not of all. With several GPUs the same call uses
them all.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
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
        whole, part = jax.sharding.PartitionSpec(), jax.sharding.PartitionSpec("batch")
        specs = tuple(whole if i < num_shared else part for i in range(len(args)))

        # XLA's partitioner crashes on inputs that are not used in the end (jax 0.11.2): compiled as one, what the function closes
        # over is none, and the barrier uses all others.
        def of_part(*args: Any) -> Any:
            return jax.jit(batched)(*jax.lax.optimization_barrier(args))

        return jax.shard_map(of_part, mesh=mesh, in_specs=specs, out_specs=part, check_vma=False)(*args)

    return wrapped
