"""How fast, against what, and in how much memory: `make bench`, `make costs`, `make throughput`.

Each in one process on the same work, compilation apart; all take turns, so that load meets all alike. Memory is
what XLA sets aside for a program besides its arguments.

`bench`: steps and gradients on the same scene, batch and number of steps; each row is the median of several runs, with the range.

- `mjx.step`: MJX as it is, its solver run to the same tolerance.
- `mg.rollout`: our step, lean carry; on scenes with many contacts that could be, also with room for the nearest alone.
- `mg value_and_grad`: implicit derivative, checkpointed, and not.
- `engine="mujoco"`: `mg.rollout` by C MuJoCo, on all cores; `C MuJoCo`: `mujoco.rollout` itself, on as many threads.
- `MuJoCo Warp`: its step, captured as a graph on a GPU; where warp-lang is installed (`pip install warp-lang`).

With `--per-core` every core is a device of its own, and `mg.over_devices` splits each row of JAX's, MJX's included.

`costs`: onset, slope at MuJoCo's motion and smoothing over the plain step and its gradient.

`throughput`: ten stiffness values × 1000 samples × three estimators on `ball_wall`, once with the softness as an argument of one
compiled program and once as ten programs, as ten runs of a script would make them. Nothing is read from a compilation cache.
"""

import copy
import functools
import importlib.util
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import cyclopts
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

import mjxgrad as mg
from experiments.problems import ASSETS
from experiments.workspace import num_cores
from mjxgrad._mjx import mjx
from mjxgrad.tasks import scene_path

_SCENES = {
    "two_bodies": scene_path("two_bodies"),
    "hopper": ASSETS / "hopper.xml",
    "half_cheetah": ASSETS / "half_cheetah.xml",
    "ant": ASSETS / "ant.xml",
    "quadruped": scene_path("quadruped"),
    "humanoid": ASSETS / "humanoid.xml",
}
# Of `bench`: contacts that a state has room for, where that is faster; in these motions no more ever act.
_ROOM = {"ant": 8, "quadruped": 8, "humanoid": 12}
# Contacts of a state that MuJoCo Warp has room for.
_WARP_ROOM = 64
_TOLERANCE = 1e-6

# Of `costs`: from how high above contact a scene starts (m), as index in qpos and height; and how many steps it takes.
_STARTS = {"two_bodies": (2, 0.02), "hopper": (1, 0.05)}
_NUM_STEPS = 100
# Made when they are asked for: an array would begin JAX before `--per-core` is read.
_WAYS: dict[str, Callable[[], dict[str, Any]]] = {
    "": dict,
    "onset": lambda: {"contact": mg.Onset()},
    "slope": lambda: {"contact": mg.Slope()},
    "smoothed": lambda: {"contact": mg.Smoothing(1e-3)},
    "smoothed backward": lambda: {"contact": mg.Smoothing(1e-3, mode="backward")},
}
_COSTS = {
    "rollout": ("", "onset", "smoothed"),
    "value_and_grad": ("", "onset", "slope", "smoothed", "smoothed backward"),
    "jvp": ("", "onset", "slope"),
}

_TRANSFORMS: dict[str, Callable[[Callable], Callable]] = {
    "rollout": lambda one: one,
    "value_and_grad": jax.value_and_grad,
    "jvp": lambda one: lambda qvel: jax.jvp(one, (qvel,), (jnp.ones_like(qvel),)),
}

# Of `throughput`.
_STIFFNESS = np.logspace(1, 5, 10)  # no array of JAX, as above
_ANGLE = 0.65
_ESTIMATORS = (mg.estimators.first_order, mg.estimators.zeroth_order, mg.estimators.alpha_order)


class Row(NamedTuple):
    """One measurement: seconds of each run, seconds to compile, bytes of temporary memory."""

    name: str
    runs: list[float]
    compilation: float
    memory: float

    @property
    def median(self) -> float:
        return statistics.median(self.runs) if self.runs else float("nan")


_Many = cyclopts.Parameter(consume_multiple=True, negative="")
SceneName = Literal["two_bodies", "hopper", "half_cheetah", "ant", "quadruped", "humanoid"]


@cyclopts.Parameter(name="*")
@dataclass(frozen=True)
class Bench:
    """What `bench` measures."""

    scene: Annotated[tuple[SceneName, ...], _Many] = tuple(_SCENES)  # pyright: ignore[reportAssignmentType]
    """The scenes."""
    batch: Annotated[tuple[int, ...], _Many] = (256,)
    """States that are stepped together."""
    steps: int = 100
    """Steps of a rollout."""
    runs: int = 5
    """Runs of each; 0 compiles and reports memory, which may exceed the machine's."""
    forward: bool = False
    """Leave out all gradients."""
    per_core: bool = False
    """Split every batch over one CPU device per core."""


def announce(work: str) -> None:
    """Print the machine, the work and the versions."""
    print(
        f"{len(jax.devices())} × {jax.devices()[0].device_kind}, {num_cores()} cores, {work}; "
        f"Python {platform.python_version()}, jax {jax.__version__}, mujoco {mujoco.__version__}"
    )


def _seconds(function: Callable, *arguments: Any) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - begin


def _compile(function: Any, *arguments: Any) -> tuple[Any, float, float]:
    """Give the compiled program, the seconds that it took to compile, and the bytes of its temporary memory."""
    begin = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds, memory = time.perf_counter() - begin, program.memory_analysis()
    return program, seconds, memory.temp_size_in_bytes if memory else float("nan")


def bench(*, options: Bench | None = None) -> None:
    """Measure speed and memory against mjx.step: one table per scene and batch, and a picture of several batches."""
    options = options or Bench()
    mg.keep_compiled()
    if options.per_core:
        jax.config.update("jax_num_cpu_devices", num_cores())
    announce(f"{options.steps} steps, float32, tolerance {_TOLERANCE}, median of {options.runs} runs [range]")
    for name in options.scene:
        for batch in options.batch:
            _print(f"{name}, batch {batch}", _rows(name, batch, options), batch * options.steps)


def _rows(name: str, batch: int, options: Bench) -> Iterator[Row]:
    mj_model = mujoco.MjModel.from_xml_path(str(_SCENES[name]))
    mj_model.opt.tolerance, mj_model.opt.iterations, mj_model.opt.ls_iterations = _TOLERANCE, 100, 20
    mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    scene = mg.load_scene(mj_model)
    states = _states(mj_model, batch)
    ours, is_cpu = functools.partial(_outcome, scene, steps=options.steps), jax.default_backend() == "cpu"
    theirs = functools.partial(_mjx_outcome, scene, steps=options.steps)
    cases: dict[str, Callable] = {"mjx.step": theirs, "mg.rollout": ours}
    if name in _ROOM:
        nearest = functools.partial(_outcome, mg.load_scene(mj_model, max_contacts=_ROOM[name]), steps=options.steps)
        cases[f"mg.rollout, {_ROOM[name]} contacts"] = nearest
        cases[f"mg value_and_grad, {_ROOM[name]} contacts"] = jax.value_and_grad(nearest)
    if is_cpu and len(jax.devices()) == 1:
        by_c = scene.with_engine("mujoco")
        cases['mg.rollout, engine="mujoco"'] = functools.partial(_outcome, by_c, steps=options.steps)
    cases["mg value_and_grad"] = jax.value_and_grad(ours)
    cases["mg value_and_grad, all kept"] = jax.value_and_grad(functools.partial(ours, checkpoint=False))
    if options.forward:
        cases = {case: function for case, function in cases.items() if "grad" not in case}
    yield from _in_turns({case: mg.over_devices(one) for case, one in cases.items()}, options.runs, states)
    if is_cpu and options.runs:
        yield _native(mj_model, states, options)
    if options.runs and importlib.util.find_spec("warp"):
        yield _warp(mj_model, states, options)


def _states(mj_model: mujoco.MjModel, batch: int) -> tuple[jax.Array, jax.Array]:
    """Return positions and velocities after the scene has fallen for half a second, stirred a little."""
    data = mujoco.MjData(mj_model)
    mujoco.mj_step(mj_model, data, round(0.5 / mj_model.opt.timestep))
    random = np.random.default_rng(0)
    qvel = data.qvel + 0.2 * random.normal(size=(batch, mj_model.nv))
    return jnp.asarray(np.tile(data.qpos, (batch, 1))), jnp.asarray(qvel)


def _outcome(scene: mg.Scene, state: tuple[jax.Array, jax.Array], steps: int, **settings: Any) -> jax.Array:
    final = mg.rollout(scene, mg.initial_state(scene, *state), horizon=steps, **settings).final
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


def _in_turns(cases: dict[str, Callable], runs: int, *given: Any) -> list[Row]:
    """Compile all, and run them in turns, of which the first finds nothing in caches and is left out."""
    compiled = {case: _compile(function, *given) for case, function in cases.items()}
    turns = [
        {case: _seconds(program, *given) for case, (program, *_) in compiled.items()}
        for _ in range(runs + 1 if runs else 0)
    ]
    return [Row(case, [turn[case] for turn in turns[1:]], *rest) for case, (_, *rest) in compiled.items()]


def _warp(mj_model: mujoco.MjModel, states: tuple[jax.Array, jax.Array], options: Bench) -> Row:
    import warp  # pyright: ignore[reportMissingImports]
    from mujoco.mjx.third_party import mujoco_warp

    warp.config.quiet = True
    qpos, qvel = (np.asarray(x) for x in states)
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos[0]
    mujoco.mj_forward(mj_model, data)
    mj_model = copy.copy(mj_model)
    mj_model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # it refuses PGS, which the humanoid asks for
    model = mujoco_warp.put_model(mj_model)
    worlds = mujoco_warp.put_data(mj_model, data, nworld=len(qpos), nconmax=_WARP_ROOM, njmax=4 * _WARP_ROOM)
    begin = time.perf_counter()
    mujoco_warp.step(model, worlds)
    graph = None
    if warp.get_device().is_cuda:
        with warp.ScopedCapture() as capture:
            mujoco_warp.step(model, worlds)
        graph = capture.graph
    compilation = time.perf_counter() - begin

    def run() -> None:
        worlds.qpos.assign(qpos)
        worlds.qvel.assign(qvel)
        worlds.qacc_warmstart.zero_()
        for _ in range(options.steps):
            mujoco_warp.step(model, worlds) if graph is None else warp.capture_launch(graph)
        warp.synchronize()

    return Row("MuJoCo Warp", [_seconds(run) for _ in range(options.runs + 1)][1:], compilation, float("nan"))


def _native(mj_model: mujoco.MjModel, states: tuple[jax.Array, jax.Array], options: Bench) -> Row:
    threads = num_cores()
    data = [mujoco.MjData(mj_model) for _ in range(threads)]
    size = mujoco.mj_stateSize(mj_model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    batch = len(states[0])
    initial = np.zeros((batch, size))
    state = np.concatenate([np.asarray(x, np.float64) for x in states], axis=1)
    initial[:, 1 : 1 + state.shape[1]] = state
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        run = functools.partial(pool.rollout, nstep=options.steps)
        seconds = [_seconds(run, [mj_model] * batch, data, initial) for _ in range(options.runs + 1)]
    return Row(f"C MuJoCo, {threads} threads", seconds[1:], 0.0, float("nan"))


def _print(title: str, rows: Iterable[Row], steps: int) -> None:
    """Print rows as they come, each beside the first."""
    print(f"\n{title}")
    base = None
    for row in rows:
        base = base or row
        span = f"[{min(row.runs) * 1e3:.1f}, {max(row.runs) * 1e3:.1f}]" if row.runs else ""
        memory = "" if np.isnan(row.memory) else f"{row.memory / 1e6:9.1f} MB"
        print(
            f"  {row.name:34s} {row.median * 1e3:9.1f} ms {span}"
            f"  {row.median / steps * 1e6:8.3f} µs/step  × {row.median / base.median:6.2f} of {base.name}"
            f"  compile {row.compilation:5.1f} s {memory}",
            flush=True,
        )


def costs(*, batch: int = 256, repeats: int = 7, only: str = "") -> None:
    """Measure what onset, slope at MuJoCo's motion and smoothing cost.

    Args:
        batch: states that are stepped together.
        repeats: runs of each case.
        only: a word that cases must hold, besides the plain ones.
    """
    mg.keep_compiled()
    announce(f"batch {batch}, {_NUM_STEPS} steps")
    for name, (place, height) in _STARTS.items():
        scene = mg.load_scene(_SCENES[name])
        qpos = scene.data.qpos.at[place].add(height)
        qvel = 0.3 * jax.random.normal(jax.random.key(0), (batch, scene.model.nv))

        def cost(qvel: jax.Array, scene: mg.Scene = scene, qpos: jax.Array = qpos, **settings: Any) -> jax.Array:
            state = mg.initial_state(scene, qpos=qpos, qvel=qvel)
            return jnp.sum(mg.rollout(scene, state, horizon=_NUM_STEPS, **settings).qpos[-1] ** 2)

        for what, ways in _COSTS.items():
            # The plain one comes first, beside which the others are printed.
            cases = {f"{what}, {way}" if way else what: functools.partial(cost, **_WAYS[way]()) for way in ways}
            chosen = {case: one for case, one in cases.items() if case == what or only in case}
            programs = {case: jax.vmap(_TRANSFORMS[what](one)) for case, one in chosen.items()}
            _print(f"{name}, batch {batch}, {what}", _in_turns(programs, repeats, qvel), batch * _NUM_STEPS)


def engines(
    *,
    scene: Annotated[tuple[str, ...], _Many] = ("hopper", "quadruped", "humanoid"),
    engine: Annotated[tuple[mg.stepping.EngineName, ...], _Many] = ("mujoco", "mjx"),
    gradient: mg.stepping.Gradient = "slope",
    batch: Annotated[tuple[int, ...], _Many] = (1, 16, 256),
    steps: int = 50,
    repeats: int = 3,
) -> None:
    """Measure a gradient by the start's velocities and all controls, of each engine and of what people write by hand.

    Args:
        scene: the scenes, by name, or paths of files of your own.
        engine: the engines.
        gradient: the derivative.
        batch: states that are stepped together.
        steps: steps of a rollout.
        repeats: runs after the first one.
    """
    mg.keep_compiled()
    announce(f"{steps} steps, float32, {gradient} gradient")
    for name in scene:
        model = mujoco.MjModel.from_xml_path(str(_SCENES.get(name, name)))
        if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # MuJoCo's own differences refuse it
        loaded = mg.load_scene(model)
        for size in batch:
            random = np.random.default_rng(0)
            speeds = jnp.asarray(0.3 * random.normal(size=(size, loaded.model.nv)), loaded.data.qpos.dtype)
            controls = jnp.asarray(0.1 * random.normal(size=(size, steps, loaded.model.nu)), speeds.dtype)

            def cost(
                speeds: jax.Array, controls: jax.Array, by: mg.stepping.EngineName, scene: mg.Scene = loaded
            ) -> jax.Array:
                scene, contact = scene.with_engine(by), mg.stepping.own_motion(gradient)
                return jnp.sum(
                    mg.rollout(scene, mg.initial_state(scene, qvel=speeds), controls, contact=contact).qpos[-1]
                )

            programs: dict[str, Callable] = {
                by: jax.vmap(jax.grad(functools.partial(cost, by=by), argnums=(0, 1))) for by in engine
            }
            took = _by_hand(loaded.mj_model, np.asarray(speeds, float), np.asarray(controls, float))
            by_hand = Row("mjd_transitionFD in a Python loop", [took], 0.0, float("nan"))
            rows = [*_in_turns(programs, repeats, speeds, controls), by_hand]
            _print(f"{name}, batch {size}", rows, size * steps)


def _by_hand(model: mujoco.MjModel, speeds: np.ndarray, controls: np.ndarray) -> float:
    """Return how long a loop of steps and of MuJoCo's own differences takes (s); without the recursion that a gradient needs."""
    data, started = mujoco.MjData(model), time.perf_counter()
    size = 2 * model.nv + model.na
    matrix, by_control = np.zeros((size, size)), np.zeros((size, model.nu))
    for speed, rows in zip(speeds, controls, strict=True):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = speed
        for row in rows:
            data.ctrl[:] = row
            mujoco.mjd_transitionFD(model, data, 1e-6, True, matrix, by_control, None, None)
            mujoco.mj_step(model, data)
    return time.perf_counter() - started


def throughput(*, samples: int = 1000) -> None:
    """Measure a sweep over softness in one program against ten, and the memory of the three estimators.

    Args:
        samples: rollouts of an estimate.
    """
    jax.config.update("jax_enable_compilation_cache", False)
    announce(f"{samples} samples, float32")
    task, key = mg.tasks.ball_wall(), jax.random.key(0)

    def estimates(stiffness: jax.Array, key: jax.Array, num_samples: int = samples) -> list:
        objective = task.objective(0.1, mg.tasks.wall_softness(stiffness))
        return [estimator(objective, jnp.array([_ANGLE]), key, num_samples=num_samples) for estimator in _ESTIMATORS]

    program, compiling, _ = _compile(estimates, _STIFFNESS[0], key)
    running = sum(_seconds(program, stiffness, key) for stiffness in _STIFFNESS)
    print(f"one program, ten stiffness values: compiled in {compiling:.1f} s, ran in {running:.1f} s")
    compiled = ran = 0.0
    for stiffness in _STIFFNESS:
        jax.clear_caches()
        program, seconds, _ = _compile(functools.partial(estimates, stiffness), key)
        compiled, ran = compiled + seconds, ran + _seconds(program, key)
    print(f"{len(_STIFFNESS)} programs: compiled in {compiled:.1f} s, ran in {ran:.1f} s")
    # A process of its own would also import and load the scene.
    times = (compiled + ran) / (compiling + running)
    print(f"the sweep in one program is {times:.1f} times faster than ten programs")
    print("samples      memory of the three estimators in one program")
    for count in (10**3, 10**4, 10**5, 10**6):
        _, _, memory = _compile(functools.partial(estimates, num_samples=count), _STIFFNESS[0], key)
        print(f"{count:8d} {memory / 1e6:10.2f} MB", flush=True)
