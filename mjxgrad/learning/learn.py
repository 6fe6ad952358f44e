r"""Policies by short windows: SHAC, its α-order form, and the likelihood ratio, in one loop.

An update runs one window in every environment (see `window`), moves the policy along a mixture of both gradients, fits the
value function to TD($\lambda$) targets, and lets the target value function follow. The rule that mixes is the only
difference between methods:

| `rule` | method |
|---|---|
| `rules.FixedAlpha(1)` | first order: SHAC |
| `rules.FixedAlpha(0)` | zeroth order: REINFORCE with a value function |
| `rules.InverseVariance()` | both, by variance, for every step and action: IVW-H |
| `rules.Consistent(failure_probability=1e-3)` | the same with an eye for bias: α-order, the default |

With the settings `apg()` there is no value function: analytic policy gradients (APG).

References:
    Xu, Makoviychuk, Narang, Ramos, Matusik, Garg, Macklin. Accelerated Policy Learning with Parallel Differentiable Simulation.
    ICLR 2022, arXiv:2204.07137 (SHAC). Onoda et al., arXiv:2604.18161 (IVW-H).
"""

import csv
import functools
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import sync_global_devices
from jaxtyping import Array, Float, Key, UInt32

from mjxgrad._programs import compile_once
from mjxgrad.batched.device import all_devices
from mjxgrad.envs import Environment
from mjxgrad.learning.learner import Learner, Policy, Settings, begin
from mjxgrad.learning.update import update
from mjxgrad.optimiser import checkpoint as checkpoints

Log = Callable[[int, dict[str, float]], Any]


class Learned(eqx.Module):
    """What came of it.

    Attributes:
        policy: to act by.
        history: by name, one number per update; see `learn`.
        learner: to go on from.
    """

    policy: Policy
    history: dict[str, Float[Array, "updates *policies"]]
    learner: Learner


def learn(
    environment: Environment | Sequence[Environment],
    key: Key[Array, "*seeds"] | UInt32[Array, "*seeds 2"],
    *,
    num_updates: int,
    settings: Settings | None = None,
    log: Log | None = None,
    log_every: int = 10,
    checkpoint: str | Path | None = None,
) -> Learned:
    """Learn a policy.

    Its history has a number per update:

    - `reward`, mean per step; `return`, mean of the episodes that ended, NaN without any;
    - `alpha`, mean weight of first order; `gradient_norm`, by the parameters;
    - `first_variance`, `zeroth_variance` of one environment's gradient by its actions; `squared_bias`, of the difference of
      their means, less what noise explains, so that it may be negative;
    - `ended`, share of windows in which an episode ended for good: no derivative sees across that;
    - `not_finite`, share of first-order gradients that were not numbers; `shortened`, of those that were too large, see
      `Settings.largest_sample`; `diverged`, steps without a meaningful next state;
      `skipped`, 1 if the mixture was not finite and nothing was changed;
    - `critic_loss`;
    - `seconds`, of the clock for an update of all policies, without compilation.

    Args:
        environment: to learn in; or several that differ in numbers alone, such as the stiffness of contact. All learn side by
            side from the same keys, and what is returned gets a first axis for them.
        key: consumed here; an array of several learns as many policies side by side, and what is returned gets an axis for them.
        num_updates: in all, those before a checkpoint included.
        settings: how; None are the defaults.
        log: called after every `log_every` updates with their means: `to_csv("run.csv")`, or for a tracker
            `lambda update, metrics: wandb.log(metrics, step=update)`.
        log_every: updates in one program; between them are logs and checkpoints.
        checkpoint: file to go on from if it is there, and to write after every `log_every` updates. The same settings, the same
            environment in numbers and code, and the same key are needed; the result is that of an uninterrupted run to the bit,
            but for `seconds`.

    Raises:
        ValueError: if a number is below 1, environments differ in more than numbers, or the checkpoint is of another run.
    """
    settings = Settings() if settings is None else settings
    for name, number in (("num_updates", num_updates), ("log_every", log_every)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.wrap_key_data(key)
    place, jit = _on_all_devices()
    # As arguments, the environments' numbers are no part of the program: one that is stiffer needs no other.
    is_one = isinstance(environment, Environment)
    environments = [environment] if is_one else list(environment)
    if not environments:
        raise ValueError("environment must be one or several, got an empty sequence")
    own, common, structure = _apart(environments)
    arrays = place((own, common))

    of_each = functools.partial(
        _of_each,
        structure=structure,
        num_environments=None if is_one else len(environments),
        has_seeds=bool(key.ndim),
        settings=settings,
        num_updates=num_updates,
    )
    shape = key.shape if is_one else (len(environments), *key.shape)
    # As numbers on the host, a key is the same in all processes.
    numbers, kind = np.asarray(jax.random.key_data(key)), jax.random.key_impl(key)
    numbers = np.broadcast_to(numbers, (*shape, *numbers.shape[key.ndim :]))
    start = jit(lambda arrays, numbers: of_each(begin, arrays)(jax.random.wrap_key_data(numbers, impl=kind)))
    learner = compile_once(start.lower(arrays, numbers))(arrays, numbers)
    one = jax.jit(lambda arrays, learner: of_each(update, arrays)(learner)).trace(arrays, learner)
    found = one.out_info[1]
    found["seconds"] = jax.ShapeDtypeStruct(shape, np.float64)
    history = {name: np.zeros((0, *x.shape), x.dtype) for name, x in found.items()}
    path = None if checkpoint is None else Path(checkpoint)
    fingerprint = {} if path is None else _fingerprint(environments, settings, num_updates, key, one.lower().as_text())
    if path is not None and path.is_file():
        learner, history = checkpoints.load(path, (learner, history), fingerprint)
        learner = place(learner)

    @functools.lru_cache
    def several(count: int) -> Callable[[Any, Learner], tuple[Learner, dict[str, Array]]]:
        def run(arrays: Any, learner: Learner) -> tuple[Learner, dict[str, Array]]:
            return jax.lax.scan(lambda now, _: of_each(update, arrays)(now), learner, length=count)

        return compile_once(jit(run).lower(arrays, learner))

    is_first = jax.process_index() == 0
    on_disk = done = int(learner.num_updates.max())

    def save() -> None:
        nonlocal on_disk
        if path is not None and is_first and done > on_disk:
            checkpoints.save(path, (learner, history), fingerprint)
            on_disk = done

    try:
        while done < num_updates:
            count = min(log_every, num_updates - done)
            program, start_time = several(count), time.perf_counter()
            learner, found = jax.block_until_ready(program(arrays, learner))
            seconds = np.full((count, *shape), (time.perf_counter() - start_time) / count)
            found = {name: np.asarray(values) for name, values in found.items()} | {"seconds": seconds}
            history = {name: np.concatenate([before, found[name]]) for name, before in history.items()}
            done += count
            save()
            if log is not None and is_first:
                log(done, {name: _mean(values) for name, values in found.items()})
    finally:
        # On the way out of an interruption, too: KeyboardInterrupt goes on to the caller.
        save()
    return Learned(learner.policy, {name: jnp.asarray(values) for name, values in history.items()}, learner)


def to_csv(path: str | os.PathLike[str]) -> Log:
    """Return a `log` for `learn` and `mg.optimise` that writes a row per call, headed by the names of the first.

    A file that is there is gone on with.

    Raises:
        ValueError: when called with other names than those in the file.
    """
    path = Path(path)

    def log(step: int, metrics: dict[str, float]) -> None:
        names = ["step", *metrics]
        is_new = not path.exists() or not path.stat().st_size
        if not is_new:
            with path.open(newline="", encoding="utf-8") as file:
                there = next(csv.reader(file))
            if there != names:
                raise ValueError(
                    f"{path} must have the columns {', '.join(names)}, got {', '.join(there)}: name another"
                )
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            if is_new:
                writer.writerow(names)
            writer.writerow([step, *metrics.values()])

    return log


def _of_each(
    function: Callable,
    arrays: tuple[Environment, Environment],
    structure: Environment,
    num_environments: int | None,
    has_seeds: bool,
    **given: Any,
) -> Callable[[Any], Any]:
    """Return a function of all policies, environment by environment and seed by seed, from one of an environment and a policy."""
    own, common = arrays

    def in_one(own: Environment, state: Any) -> Any:
        one = functools.partial(function, eqx.combine(own, common, structure), **given)
        return (jax.vmap(one) if has_seeds else one)(state)

    in_all = in_one if num_environments is None else jax.vmap(in_one, axis_size=num_environments)
    return functools.partial(in_all, own)


def _apart(environments: Sequence[Environment]) -> tuple[Environment, Environment, Environment]:
    """Return arrays that environments have each their own of, stacked, those that all share, and what is no array."""
    parts = [eqx.partition(one, eqx.is_array) for one in environments]
    (first, structure), *others = parts
    if not all(eqx.tree_equal(structure, other) for _, other in others):
        raise ValueError("environments that learn side by side must differ in numbers alone: learn in each by itself")
    is_common = jax.tree.map(lambda *x: len(set(map(checkpoints.digest, x))) == 1, *(x for x, _ in parts))
    common, own = eqx.partition(first, is_common)
    others = [eqx.filter(x, is_common, inverse=True) for x, _ in others]
    return jax.tree.map(lambda *x: jnp.stack(x), own, *others), common, structure


def _on_all_devices() -> tuple[Callable[[Any], Any], Callable[[Callable], Any]]:
    """Return how to place arrays, and how to compile what gives arrays, that all devices of all processes are to have."""
    devices = all_devices()
    if len(devices) == 1:
        return lambda tree: tree, jax.jit
    if jax.process_count() > 1:
        # Meet before compiling: by how much that differs in time can exceed the deadline for connecting.
        sync_global_devices("learn")
    whole = jax.sharding.NamedSharding(jax.sharding.Mesh(np.array(devices), ("batch",)), jax.sharding.PartitionSpec())

    def put(x: Array) -> Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(jax.random.key_data(x)), impl=jax.random.key_impl(x))
        # From the host: what one process has on a device others cannot always be sent.
        return jax.device_put(np.asarray(x), whole)

    return functools.partial(jax.tree.map, put), functools.partial(jax.jit, out_shardings=whole)


def _mean(values: np.ndarray) -> float:
    """Return the mean of what is a number; NaN if nothing is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _fingerprint(
    environments: Sequence[Environment], settings: Settings, num_updates: int, key: Key[Array, "*seeds"], program: str
) -> dict[str, Any]:
    """Return what must agree between a checkpoint and the run that goes on from it."""
    return {
        "settings": repr(settings),
        "num_updates": num_updates,
        "environment": type(environments[0]).__qualname__,
        "numbers of the environment": checkpoints.digest(eqx.filter(environments, eqx.is_array)),
        "key": checkpoints.digest(key),
        # A class of the same name may have other code: its rewards are in the text of the lowered update.
        "program": checkpoints.digest(np.frombuffer(program.encode(), np.uint8)),
    }
