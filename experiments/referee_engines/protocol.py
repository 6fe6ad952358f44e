"""What an engine's program reads and writes: a JSON request on stdin, then one JSON line per scene and variant on stdout.

The request holds `scenes` (as in scenes.toml, with their `values`), `variants`, `packages` whose versions the first line tells,
and the `budget`, seconds beyond which fewer values do. A program is `serve(make)`, where `make(scene, variant)` returns
two functions of a value: the outcome with its derivative, and the outcome. It runs in an environment of its own.
"""

import importlib.metadata
import itertools
import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

Scene = dict[str, Any]
Pair = tuple[Callable[[float], tuple[float, float]], Callable[[float], float]]
_ROLLOUTS, _FEWEST = 16, 32  # that are timed; values that a slope takes


class UnsupportedError(Exception):
    """What an engine cannot simulate."""


def serve(make: Callable[[Scene, str], Pair]) -> None:
    """Answer the request on stdin; what engines print goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    request = json.load(sys.stdin)
    versions = {name: importlib.metadata.version(name) for name in request["packages"]}
    print(json.dumps(versions), file=answers, flush=True)
    for name, scene in request["scenes"].items():
        for variant in request["variants"]:
            try:
                found = measure(make, scene, variant, request["budget"])
            except Exception as error:  # one contestant's failure is one row
                traceback.print_exc()
                kind = "" if isinstance(error, UnsupportedError) else f"{type(error).__name__}: "
                found = {"error": f"{kind}{error}".partition("\n")[0][:300]}
            print(json.dumps({"scene": name, "variant": variant} | found), file=answers, flush=True)


def measure(make: Callable[[Scene, str], Pair], scene: Scene, variant: str, budget: float) -> dict[str, Any]:
    """Differentiate at every value, one call each, and time the calls after the first."""
    begun = time.perf_counter()
    gradient, rollout = make(scene, variant)
    values = scene["values"]
    gradient(values[0])
    found: dict[str, Any] = {"compile_seconds": time.perf_counter() - begun}
    rollout(values[0])
    seconds, every = _timed(gradient, values[:1])[1][0], 1
    while seconds * len(values[::every]) > budget and len(values) >= 2 * every * _FEWEST:
        every *= 2
    found["values"] = values[::every]
    pairs, found["gradient_seconds"] = _timed(gradient, found["values"])
    _, found["rollout_seconds"] = _timed(rollout, found["values"][:_ROLLOUTS])
    found["outcomes"], found["derivatives"] = ([float(pair[i]) for pair in pairs] for i in (0, 1))
    return found


def _timed(call: Callable[[float], Any], values: list[float]) -> tuple[list[Any], list[float]]:
    found, times = [], [time.perf_counter()]
    for value in values:
        found.append(call(value))
        times.append(time.perf_counter())
    return found, [after - before for before, after in itertools.pairwise(times)]


def by_jax(outcome: Callable[[Any], Any], *, forward: bool = False) -> Pair:
    """Compile a traceable outcome, and its derivative by reverse or forward mode; calls wait for the numbers."""
    import jax
    import jax.numpy as jnp

    pushed = jax.jit(lambda value: jax.jvp(outcome, (value,), (jnp.ones_like(value),)))
    gradient, plain = pushed if forward else jax.jit(jax.value_and_grad(outcome)), jax.jit(outcome)
    return (
        lambda value: tuple(map(float, gradient(jnp.asarray(value, float)))),  # pyright: ignore[reportReturnType]
        lambda value: float(plain(jnp.asarray(value, float))),
    )


def starts(scene: Scene, model: Any, value: Any) -> tuple[Any, Any, Any]:
    """Return positions, velocities and controls at the start as JAX's arrays, of an MjModel."""
    import jax.numpy as jnp

    parts = {"qpos": jnp.asarray(model.qpos0, float), "qvel": jnp.zeros(model.nv), "ctrl": jnp.zeros(model.nu)}
    parts["qvel"] = parts["qvel"].at[0].set(scene.get("speed", 0.0))
    kind, index = scene["vary"]
    parts[kind] = parts[kind].at[index].add(value)
    return parts["qpos"], parts["qvel"], parts["ctrl"]
