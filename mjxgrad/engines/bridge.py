"""Steps of MuJoCo Warp as operations of JAX: what worlds are given goes in, what is wanted comes out, the rest stays."""

import copy
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

NUMBER = "model."
"""What the names of the model's numbers begin with that are not those of its file."""
Values = dict[str, Array]
"""Arrays by name, whose leading axis is worlds."""
_MOST_STORES = 4  # numbers of worlds for which an operation keeps Warp's data
# MuJoCo's numbers which Warp keeps as functions of them.
_KEPT_AS: dict[str, tuple[str, Callable[[Array], Array]]] = {
    "opt.impratio": ("opt.impratio_invsqrt", lambda ratio: ratio**-0.5)
}


@dataclasses.dataclass(frozen=True)
class Room:
    """Room of a world."""

    contacts: int
    rows: int


class Program:
    """A function of MuJoCo Warp, `step` or `forward`, with one C model."""

    def __init__(self, mj_model: mujoco.MjModel, function: str, wanted: Iterable[str], room: Room):
        import warp
        from mujoco.mjx.third_party import mujoco_warp

        self._mj_model, self._room, self._warp, self._mjw = mj_model, room, warp, mujoco_warp
        self._function = getattr(mujoco_warp, function)
        self._models: dict[str, Any] = {}
        self._operations: dict[tuple[str, ...], Callable[[Array], Array]] = {}
        with warp.ScopedDevice("cpu"):
            data, self._own = self._data(1), self._model()
        self.bytes_each = sum(x.capacity for part in (data, data.efc, data.contact) for x in _arrays(part))
        self._wanted = {name: _get(data, name).numpy() for name in wanted}
        self._sizes = {name: _flat(warp, _get(data, name), 1).shape[1] for name in self._wanted}

    def __call__(self, given: Values) -> Values:
        """Return what is wanted, with worlds as the leading axis, of values by the names of Warp's data.

        Numbers of the model begin with `NUMBER`; those that Warp does not have are left out.
        """
        renamed = {}
        for name, value in given.items():
            known, function = _KEPT_AS.get(name.removeprefix(NUMBER), (None, None))
            renamed[NUMBER + known if known else name] = function(value) if function else value
        given = {k: x for k, x in renamed.items() if x.size and (not k.startswith(NUMBER) or self.has(k))}
        names = tuple(sorted(given))
        if names not in self._operations:
            self._operations[names] = self._operation(names)
        count = len(given["qpos"])
        packed = jnp.concatenate([given[k].reshape(count, -1).astype(jnp.float32) for k in names], axis=1)
        found = self._operations[names](packed)
        parts = jnp.split(found, np.cumsum(list(self._sizes.values())), axis=1)
        return {k: self._read(k, part) for k, part in zip(self._wanted, parts, strict=False)}

    def has(self, name: str) -> bool:
        """Return whether Warp has a number of the model."""
        name = name.removeprefix(NUMBER)
        return isinstance(_get(self._own, _KEPT_AS.get(name, (name,))[0]), self._warp.array)

    def _read(self, name: str, part: Array) -> Array:
        like = self._wanted[name]
        if like.dtype != np.float32:
            part = jax.lax.bitcast_convert_type(part, like.dtype)
        return part.reshape(len(part) * len(like), *like.shape[1:])

    def _operation(self, names: tuple[str, ...]) -> Callable[[Array], Array]:
        warp, stores = self._warp, {}
        run = lambda given, found: self._run(names, stores, given, found)  # noqa: E731
        run.__annotations__ = {name: warp.array(dtype=float, ndim=2) for name in ("given", "found")}  # pyright: ignore
        # Warp would capture a graph for each call of a program; one for each number of worlds is enough.
        call = warp.jax_callable(run, graph_mode=warp.JaxCallableGraphMode.NONE)
        width = sum(self._sizes.values())
        return lambda given: call(given, output_dims={"found": (len(given), width)})[0]

    def _run(self, names: tuple[str, ...], stores: dict[tuple[str, int], "_Store"], given: Any, found: Any) -> None:
        warp, key = self._warp, (str(self._warp.get_device()), len(given))
        if key not in stores:
            if len(stores) == _MOST_STORES:
                warp.synchronize()  # before the memory of one is given back that a kernel may still use
                stores.pop(next(iter(stores)))
            stores[key] = self._store(names, len(given))
        warp.copy(stores[key].given, given)
        stores[key].run()
        warp.copy(found, stores[key].found)

    def _store(self, names: tuple[str, ...], count: int) -> "_Store":
        warp, device = self._warp, str(self._warp.get_device())
        if device not in self._models:
            self._models[device] = self._own if device == "cpu" else self._model()
        model, data = copy.copy(self._models[device]), self._data(count)
        model.opt = copy.copy(model.opt)
        targets = []
        for name in names:
            if name.startswith(NUMBER):
                holder, _, field = name.removeprefix(NUMBER).rpartition(".")
                holder = getattr(model, holder) if holder else model
                old = getattr(holder, field)
                each = getattr(old, "_is_batched", False)  # where worlds may have their own
                own = warp.zeros((count, *old.shape[1:]) if each else old.shape, dtype=old.dtype)
                own._is_batched = each
                setattr(holder, field, own)
                targets.append(_flat(warp, own, count if each else 1))
            else:
                targets.append(_flat(warp, getattr(data, name), count))
        sources = [_flat(warp, _get(data, name), count) for name in self._wanted]
        return _Store(warp, lambda: self._function(model, data), data, targets, sources)

    def _model(self) -> Any:
        model = self._mjw.put_model(self._mj_model)
        model.opt.warn_overflow = 0  # a step counts what it lacked room for
        return model

    def _data(self, count: int) -> Any:
        return self._mjw.make_data(self._mj_model, count, nconmax=self._room.contacts, njmax=self._room.rows)


class _Store:
    """Warp's data for so many worlds, between one array of all that they are given and one of all that is wanted."""

    def __init__(self, warp: Any, function: Callable[[], None], data: Any, targets: list[Any], sources: list[Any]):
        self._warp, self._function, self._data, self._targets, self._sources = warp, function, data, targets, sources
        count = data.nworld
        self.given, self.found = (warp.zeros((count, sum(x.shape[1] for x in xs))) for xs in (targets, sources))
        self._graph = None

    def run(self) -> None:
        """Find what is wanted; on a GPU all kernels are launched as one graph."""
        device = self.given.device
        if not device.is_cuda:
            self._launch()
            return
        if self._graph is not None:
            self._warp.capture_launch(self._graph)
            return
        self._launch()  # loads the kernels, which a capture does not
        with self._warp.ScopedCapture(device) as capture:
            self._launch()
        self._graph = capture.graph

    def _launch(self) -> None:
        self._data.overflow.zero_()
        column = 0
        for target in self._targets:
            width = target.shape[1]
            self._warp.copy(target, self.given[: len(target), column : column + width])
            column += width
        self._function()
        column = 0
        for source in self._sources:
            width = source.shape[1]
            self._warp.copy(self.found[:, column : column + width], source)
            column += width


def _flat(warp: Any, array: Any, count: int) -> Any:
    """Return the bytes of an array as numbers of single precision, in so many rows."""
    size = array.size * warp.types.type_size_in_bytes(array.dtype) // 4 // count
    return warp.array(ptr=array.ptr, dtype=float, shape=(count, size), device=array.device)


def _get(holder: Any, path: str) -> Any:
    for name in path.split("."):
        holder = getattr(holder, name, None)
    return holder


def _arrays(part: Any) -> list[Any]:
    return [x for x in vars(part).values() if hasattr(x, "capacity")]
