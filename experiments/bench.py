"""How fast, against what: `make bench`.

Everything is measured in one process on the same work: the same scene, the same batch of states, the same number of steps.
Compilation is apart. Each row is the median of several runs with their range, and the peak of temporary memory that XLA
reports for the compiled program.

- `mjx.step`: MJX as it is, its solver run to the same tolerance.
- `mg.rollout`: our step, lean carry.
- `mjx patched, value_and_grad`: MJX's solver loop replaced by a scan, since reverse mode refuses the loop: the usual way out.
- `mg value_and_grad`: implicit derivative, checkpointed, and not.
- `C MuJoCo`: `mujoco.rollout` on as many threads as there are cores.

With `--per-core` every core is a device of its own, and each row of JAX's, MJX's included, is split over them by
`mg.over_devices`.
"""

import argparse
import dataclasses
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

import mjxgrad as mg
from experiments.parallel import num_cores
from mjxgrad._mjx import mjx

_ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
_SCENES = {
    "two_bodies": Path(__file__).parents[1] / "mjcf" / "two_bodies.xml",
    "hopper": _ASSETS / "hopper.xml",
    "half_cheetah": _ASSETS / "half_cheetah.xml",
}
_TOLERANCE = 1e-6
_PATCHED_ITERATIONS = 10


@dataclasses.dataclass(frozen=True)
class Row:
    """One measurement: seconds of each run, seconds to compile, bytes of temporary memory."""

    name: str
    runs: tuple[float, ...]
    compilation: float
    memory: float

    @property
    def median(self) -> float:
        return statistics.median(self.runs) if self.runs else float("nan")


def main() -> None:
    """Print one table per scene."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scene", nargs="*", choices=list(_SCENES), default=list(_SCENES))
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument(
        "--runs", type=int, default=5, help="0 compiles and reports memory, which may exceed the machine's"
    )
    parser.add_argument("--skip-patched", action="store_true", help="leave out MJX's own gradient")
    parser.add_argument("--per-core", action="store_true", help="split every batch over one CPU device per core")
    options = parser.parse_args()
    if options.per_core:
        jax.config.update("jax_num_cpu_devices", num_cores())
    print(
        f"{len(jax.devices())} × {jax.devices()[0].device_kind}, {num_cores()} cores, batch {options.batch}, "
        f"{options.steps} steps, float32, tolerance {_TOLERANCE}, median of {options.runs} runs [range]; "
        f"Python {platform.python_version()}, jax {jax.__version__}, mujoco {mujoco.__version__}"
    )
    for name in options.scene:
        print(f"\n{name}")
        rows: list[Row] = []
        for row in _measure(name, options):
            rows.append(row)
            print(_format(row, rows, options), flush=True)


def _measure(name: str, options: argparse.Namespace) -> Iterator[Row]:
    mj_model = mujoco.MjModel.from_xml_path(str(_SCENES[name]))
    mj_model.opt.tolerance, mj_model.opt.iterations, mj_model.opt.ls_iterations = _TOLERANCE, 100, 20
    mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    scene = mg.load_scene(mj_model)
    states = _states(mj_model, options.batch)
    runs = options.runs
    yield _time("mjx.step", mg.over_devices(lambda s: _mjx_outcome(scene, s, options.steps)), states, runs)
    for checkpoint, label in ((True, ""), (False, ", all kept")):

        def outcome(state: Any, checkpoint: bool = checkpoint) -> Any:
            return _outcome(scene, state, options.steps, checkpoint)

        if checkpoint:
            yield _time("mg.rollout", mg.over_devices(outcome), states, runs)
        yield _time(f"mg value_and_grad{label}", mg.over_devices(jax.value_and_grad(outcome)), states, runs)
    if not options.skip_patched:
        yield _patched(scene, states, options)
    if jax.default_backend() == "cpu" and runs:
        yield _native(mj_model, states, options)


def _states(mj_model: mujoco.MjModel, batch: int) -> tuple[jax.Array, jax.Array]:
    """Return positions and velocities after the scene has fallen for half a second, stirred a little."""
    data = mujoco.MjData(mj_model)
    mujoco.mj_step(mj_model, data, round(0.5 / mj_model.opt.timestep))
    random = np.random.default_rng(0)
    qvel = data.qvel + 0.2 * random.normal(size=(batch, mj_model.nv))
    return jnp.asarray(np.tile(data.qpos, (batch, 1))), jnp.asarray(qvel)


def _outcome(scene: mg.Scene, state: tuple[jax.Array, jax.Array], steps: int, checkpoint: bool) -> jax.Array:
    start = mg.initial_state(scene, *state)
    final = mg.rollout(scene, start, horizon=steps, checkpoint=checkpoint).final
    return jnp.sum(final.qpos**2) + jnp.sum(final.qvel**2)


def _mjx_outcome(scene: mg.Scene, state: tuple[jax.Array, jax.Array], steps: int) -> jax.Array:
    data = scene.data.replace(qpos=state[0], qvel=state[1])

    def body(carry: tuple[jax.Array, ...], _: None) -> tuple[tuple[jax.Array, ...], None]:
        qpos, qvel, act, warm = carry
        moved = mjx.step(scene.model, data.replace(qpos=qpos, qvel=qvel, act=act, qacc_warmstart=warm))
        return (moved.qpos, moved.qvel, moved.act, moved.qacc_warmstart), None

    start = (data.qpos, data.qvel, data.act, data.qacc_warmstart)
    final, _ = jax.lax.scan(body, start, length=steps)
    return jnp.sum(final[0] ** 2) + jnp.sum(final[1] ** 2)


def _patched(scene: mg.Scene, states: Any, options: argparse.Namespace) -> Row:
    """Measure MJX's own gradient with `while_loop` replaced by a scan that stops counting once it is done."""
    model = scene.model.tree_replace({"opt.iterations": _PATCHED_ITERATIONS})
    patched_scene = dataclasses.replace(scene, model=model)

    def scan_loop(goes_on: Callable, body: Callable, start: Any) -> Any:
        def turn(value: Any, _: None) -> tuple[Any, None]:
            keep = goes_on(value)
            moved = body(value)
            return jax.tree.map(lambda new, old: jnp.where(keep, new, old), moved, value), None

        first = jax.tree.map(jnp.asarray, start)
        dtypes = jax.eval_shape(body, first)
        first = jax.tree.map(lambda x, d: jnp.broadcast_to(x, d.shape).astype(d.dtype), first, dtypes)
        return jax.lax.scan(turn, first, length=_PATCHED_ITERATIONS)[0]

    original, jax.lax.while_loop = jax.lax.while_loop, scan_loop
    try:
        function = mg.over_devices(jax.value_and_grad(lambda s: _mjx_outcome(patched_scene, s, options.steps)))
        return _time("mjx patched, value_and_grad", function, states, min(options.runs, 3))
    finally:
        jax.lax.while_loop = original


def _time(name: str, function: Callable, states: Any, runs: int) -> Row:
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(states).compile()
    compilation = time.perf_counter() - begin
    seconds = []
    if runs:
        jax.block_until_ready(compiled(states))
    for _ in range(runs):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(states))
        seconds.append(time.perf_counter() - begin)
    return Row(name, tuple(seconds), compilation, compiled.memory_analysis().temp_size_in_bytes)  # pyright: ignore[reportOptionalMemberAccess]


def _native(mj_model: mujoco.MjModel, states: tuple[jax.Array, jax.Array], options: argparse.Namespace) -> Row:
    threads = num_cores()
    data = [mujoco.MjData(mj_model) for _ in range(threads)]
    size = mujoco.mj_stateSize(mj_model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial = np.zeros((options.batch, size))
    state = np.concatenate([np.asarray(x, np.float64) for x in states], axis=1)
    initial[:, 1 : 1 + state.shape[1]] = state
    seconds = []
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        for _ in range(options.runs + 1):
            begin = time.perf_counter()
            pool.rollout([mj_model] * options.batch, data, initial, nstep=options.steps)
            seconds.append(time.perf_counter() - begin)
    return Row(f"C MuJoCo, {threads} threads", tuple(seconds[1:]), 0.0, float("nan"))


def _format(row: Row, rows: list[Row], options: argparse.Namespace) -> str:
    steps = options.batch * options.steps
    span = f"[{min(row.runs) * 1e3:.1f}, {max(row.runs) * 1e3:.1f}]" if row.runs else ""
    memory = "" if np.isnan(row.memory) else f"{row.memory / 1e6:9.1f} MB"
    return (
        f"  {row.name:28s} {row.median * 1e3:9.1f} ms {span}"
        f"  {row.median / steps * 1e6:8.3f} µs/step  × {row.median / rows[0].median:6.2f} of mjx.step"
        f"  compile {row.compilation:5.1f} s {memory}"
    )


if __name__ == "__main__":
    main()
