"""What a sweep over contact softness costs, and what memory it takes: `make throughput`.

Ten stiffness values × 1000 samples × three estimators on `ball_wall`, once with the softness as an argument of one compiled
program and once as ten programs, as ten runs of a script would make them. Compilation is apart; nothing is read from a
compilation cache. Memory is what XLA sets aside for the compiled program besides its arguments, for 10³ to 10⁶ samples.
"""

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

import mjxgrad as mg

_STIFFNESS = jnp.logspace(1, 5, 10)
_ANGLE = 0.65
_ESTIMATORS = (mg.estimators.first_order, mg.estimators.zeroth_order, mg.estimators.alpha_order)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--separate", type=int, default=10, help="how many of the ten programs to compile one by one")
    parser.add_argument("--most-samples", type=int, default=10**6, help="of the table of memory")
    parser.add_argument("--run-most", action="store_true", help="run the largest number of samples, too, and time it")
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    print(
        f"{jax.devices()[0].device_kind}, {len(os.sched_getaffinity(0))} cores, {options.samples} samples, float32; "
        f"Python {platform.python_version()}, jax {jax.__version__}, mujoco {mujoco.__version__}"
    )
    task, key = mg.tasks.ball_wall(), jax.random.key(0)
    sweep = jax.jit(_estimates(task, options.samples))
    compiling, running = _compile_and_run(sweep, [(stiffness, key) for stiffness in _STIFFNESS])
    print(f"one program, ten stiffness values: compiled in {compiling:.1f} s, ran in {running:.1f} s")
    separate = [_one_by_one(task, options.samples, stiffness, key) for stiffness in _STIFFNESS[: options.separate]]
    compiled, ran = (sum(times) for times in zip(*separate, strict=True))
    print(f"{len(separate)} programs: compiled in {compiled:.1f} s, ran in {ran:.1f} s")
    # A process of its own would also import and load the scene.
    total = (compiled + ran) * len(_STIFFNESS) / len(separate)
    print(f"the sweep in one program is {total / (compiling + running):.1f} times faster than ten programs")
    _memory(task, key, options)


def _estimates(task: mg.tasks.BallWall, num_samples: int) -> Callable:
    def estimates(stiffness: jax.Array, key: jax.Array) -> list:
        objective = task.objective(0.1, mg.tasks.wall_softness(stiffness))
        return [estimator(objective, jnp.array([_ANGLE]), key, num_samples=num_samples) for estimator in _ESTIMATORS]

    return estimates


def _one_by_one(task: mg.tasks.BallWall, num_samples: int, stiffness: jax.Array, key: jax.Array) -> tuple[float, float]:
    jax.clear_caches()
    estimates = _estimates(task, num_samples)
    return _compile_and_run(jax.jit(lambda key: estimates(stiffness, key)), [(key,)])


def _compile_and_run(function: Any, arguments: list[tuple]) -> tuple[float, float]:
    """Give the seconds to compile for the first arguments, and to run all of them."""
    start = time.perf_counter()
    compiled = function.lower(*arguments[0]).compile()
    middle = time.perf_counter()
    for one in arguments:
        jax.block_until_ready(compiled(*one))
    return middle - start, time.perf_counter() - middle


def _memory(task: mg.tasks.BallWall, key: jax.Array, options: argparse.Namespace) -> None:
    print("samples      memory of the three estimators in one program")
    count = 1000
    while count <= options.most_samples:
        compiled = jax.jit(_estimates(task, count)).lower(_STIFFNESS[0], key).compile()
        print(f"{count:8d} {compiled.memory_analysis().temp_size_in_bytes / 1e6:10.2f} MB", flush=True)  # pyright: ignore[reportOptionalMemberAccess]
        if options.run_most and count == options.most_samples:
            runs = []
            for stiffness in _STIFFNESS[:3]:
                start = time.perf_counter()
                jax.block_until_ready(compiled(stiffness, key))
                runs.append(time.perf_counter() - start)
            print(
                f"{count:8d} samples × 3 estimators in {statistics.median(runs):.1f} s, the median of 3 stiffness values"
            )
        count *= 10


if __name__ == "__main__":
    main()
