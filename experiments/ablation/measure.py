"""From settings to numbers: a scene with everything, without one group, and without all that it does not need."""

import functools
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

import mjxgrad as mg
from experiments.ablation.settings import Settings
from experiments.parallel import num_compilers
from experiments.workspace import Workspace
from mjxgrad.contact.parameters import contact_pairs
from mjxgrad.diagnostics import OmissionCheck
from mjxgrad.scene.omissions import omit, switch_off

EVERYTHING, NEEDED, REACHED = "everything", "all that is not needed", "all not needed or not reached"
RENDERING, SENSORS, TENDONS = "rendering elements", "sensors", "unused tendons"
FUSED, DAMPING = "fixed bodies", "implicit damping of zero"
PAIRS, LIMITS = "contacts not reached", "limits not reached"
# Two programs round differently in every operation of every step, the moved start only once.
_ROUNDING_FACTOR = 100.0


@dataclass(frozen=True)
class Variant:
    """A scene with something left out."""

    name: str  # of the group that is left out
    scene: mg.Scene  # without it
    what: str  # what was left out, in a few words

    @property
    def num_rows(self) -> int:
        """Of constraints."""
        return int(self.scene.data._impl.nefc)


def variants(path: Path, recorded: mg.Trajectory) -> list[Variant]:
    """Build a scene with everything, without each group that it has, and without all that it does not need.

    The one with everything comes first; last the one without all that no motion needs, and where the recorded motions leave
    more unreached, the one without that, too.
    """
    with warnings.catch_warnings():
        # On the file, so the same for every variant: deprecated words, and contacts unlike C MuJoCo's.
        warnings.simplefilter("ignore", UserWarning)
        everything = mg.load_scene(path, keep_everything=True)
        unused = mg.diagnostics.unused(everything, recorded)
        found = [Variant(EVERYTHING, everything, "")]
        edits = (_without_rendering, _without_sensors, _without_tendons, _fused, _without_damping)
        for name, edit in zip((RENDERING, SENSORS, TENDONS, FUSED, DAMPING), edits, strict=True):
            edited = edit(path)
            if edited is not None:
                found.append(Variant(name, mg.load_scene(edited[0], keep_everything=True), edited[1]))
        found += _constraints(everything, unused)
        found.append(_lean(NEEDED, path, mg.LeaveOut()))
        if unused.pairs or unused.limits:
            found.append(_lean(REACHED, path, unused))
    return found


def _lean(name: str, path: Path, wanted: mg.LeaveOut) -> Variant:
    scene = mg.load_scene(path, leave_out=wanted)
    parts = {"pairs": len(scene.omitted_pairs), "limits": len(wanted.limits)}
    listed = [f"{count} {word}" for word, count in parts.items() if count]
    return Variant(name, scene, ", ".join(["as load_scene does", *listed]))


def _constraints(everything: mg.Scene, unused: mg.LeaveOut) -> Iterator[Variant]:
    for name, wanted in ((PAIRS, mg.LeaveOut(pairs=unused.pairs)), (LIMITS, mg.LeaveOut(limits=unused.limits))):
        model = everything.to_mujoco()
        omitted, omissions = omit(model, wanted)
        if omissions:
            pairs = f"{len(omitted)} of {len(everything.pairs)} pairs"
            what = f"{len(unused.limits)} limits" if name == LIMITS else pairs
            yield Variant(name, mg.load_scene(model, keep_everything=True), what)


def _without_rendering(path: Path) -> tuple[mujoco.MjModel, str] | None:
    """Delete geoms that touch nothing, sites at which nothing acts, cameras and lights; bodies keep their inertia."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    touching = {geom for pair in contact_pairs(model) for geom in (pair.geom1, pair.geom2)}
    visual = [geom for geom in spec.geoms if geom.id not in touching]
    acts = model.nsensor or model.ntendon or (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE).any()
    sites = [] if acts else list(spec.sites)
    others = [*spec.cameras, *spec.lights]
    spec.compiler.inertiafromgeom, spec.compiler.settotalmass = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO, -1.0
    for body in spec.bodies[1:]:
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = model.body_mass[body.id], model.body_ipos[body.id], model.body_iquat[body.id]
        body.inertia, body.fullinertia = model.body_inertia[body.id], [np.nan, 0, 0, 0, 0, 0]
    for element in (*visual, *sites, *others):
        spec.delete(element)
    what = f"{len(visual)} geoms, {len(sites)} sites, {len(others)} cameras and lights"
    return (spec.compile(), what) if visual or sites or others else None


def _without_sensors(path: Path) -> tuple[mujoco.MjModel, str] | None:
    spec = mujoco.MjSpec.from_file(str(path))
    sensors = list(spec.sensors)
    for sensor in sensors:
        spec.delete(sensor)
    return (spec.compile(), f"{len(sensors)} sensors") if sensors else None


def _without_tendons(path: Path) -> tuple[mujoco.MjModel, str] | None:
    """Delete all tendons, if none of them pulls, is driven, limited or tied."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    acts = (
        model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature, model.tendon_limited,
        model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, model.eq_type == mujoco.mjtEq.mjEQ_TENDON,
    )  # fmt: skip
    if not model.ntendon or model.nsensor or any(np.any(x) for x in acts):
        return None
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    return spec.compile(), f"{model.ntendon} tendons"


def _fused(path: Path) -> tuple[mujoco.MjModel, str] | None:
    before = mujoco.MjModel.from_xml_path(str(path)).nbody
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = True
    model = spec.compile()
    return (model, f"{before - model.nbody} fused into parents") if model.nbody < before else None


def _without_damping(path: Path) -> tuple[mujoco.MjModel, str] | None:
    model = mujoco.MjModel.from_xml_path(str(path))
    before = model.opt.disableflags
    switch_off(model)
    return (model, "a second factorisation") if model.opt.disableflags != before else None


@dataclass(frozen=True)
class Cost:
    """One program of one variant, beside the same one of the scene with everything."""

    seconds: Float[np.ndarray, " repeats"]  # of each run of the batch
    base_seconds: Float[np.ndarray, " repeats"]  # of the runs with everything, in the same turns
    compile_seconds: float  # to trace and compile
    base_compile_seconds: float  # likewise with everything
    flops: float  # of the program by XLA's count, a loop's body once
    base_flops: float  # likewise with everything
    is_same_program: bool  # whether the two are the same, letter for letter, before XLA compiles them
    difference: float  # largest, of any number that the programs give
    rounding: float  # largest that moving the start by a few roundings makes, with everything
    scale: float  # largest number that the program gives

    @property
    def ratio(self) -> tuple[float, float, float]:
        """Time as a share of that with everything: lower quartile, median, upper quartile over turns."""
        low, middle, high = np.quantile(self.seconds / self.base_seconds, [0.25, 0.5, 0.75])
        return float(low), float(middle), float(high)

    @property
    def is_unchanged(self) -> bool:
        """Whether nothing differs by more than rounding makes of it."""
        return self.difference <= _ROUNDING_FACTOR * max(self.rounding, np.finfo(float).eps * self.scale)

    @property
    def verdict(self) -> str:
        """Say in a word or two whether numbers are those with everything."""
        if self.is_same_program:
            return "same program"
        if self.difference == 0.0:
            return "equal"
        return "to rounding" if self.is_unchanged else f"differs by {self.difference / self.scale:.1e}"


@dataclass(frozen=True)
class VariantOutcome(Variant):
    """What a variant costs."""

    step: Cost  # cost of the motion
    gradient: Cost | None  # cost of its gradient; None if not measured
    # What the full model says of the motions from which it was told what is not reached, and of other motions of the kind;
    # empty where a group alone is left out.
    checks: Sequence[OmissionCheck]

    @property
    def costs(self) -> list[Cost]:
        """Of the motion and, where measured, of its gradient."""
        return [self.step, self.gradient] if self.gradient else [self.step]

    @property
    def is_same_program(self) -> bool:
        """Whether XLA is given what it is given with everything."""
        return all(cost.is_same_program for cost in self.costs)

    @property
    def is_unchanged(self) -> bool:
        """Whether motion and, where measured, gradient are those with everything."""
        return all(cost.is_unchanged for cost in self.costs)


@dataclass(frozen=True)
class SceneOutcome:
    """All variants of a scene, the one with everything first, and the steps of one run of a program, over its batch."""

    name: str
    variants: list[VariantOutcome]
    steps_per_run: int

    def find(self, name: str) -> VariantOutcome | None:
        """Give a variant by its name; None if the scene has none."""
        return next((variant for variant in self.variants if variant.name == name), None)


@dataclass(frozen=True)
class Outcome:
    """All that was measured, in the order of the settings."""

    settings: Settings
    scenes: list[SceneOutcome]

    def rows(self) -> list[dict[str, Any]]:
        """One row per scene and variant, for metrics.csv; the first, with everything, has every column."""
        rows = []
        for scene in self.scenes:
            for variant in scene.variants:
                row: dict[str, Any] = {
                    "scene": scene.name,
                    "left_out": variant.name,
                    "what": variant.what,
                    "pairs": len(variant.scene.pairs),
                    "rows": variant.num_rows,
                    "bodies": int(variant.scene.model.nbody),
                }
                missed = [len(check.missed) for check in variant.checks] or ("", "")
                row |= dict(zip(("missed_recorded", "missed_others"), missed, strict=True))
                for word, cost in zip(("step", "gradient"), variant.costs, strict=False):
                    low, middle, high = cost.ratio
                    row |= {
                        f"{word}_microseconds": 1e6 * float(np.median(cost.seconds)) / scene.steps_per_run,
                        f"{word}_ratio_low": low,
                        f"{word}_ratio": middle,
                        f"{word}_ratio_high": high,
                    }
                    parts = ("compile_seconds", "flops", "difference", "rounding", "scale")
                    row |= {f"{word}_{part}": getattr(cost, part) for part in parts}
                rows.append(row)
        return rows


_OWN = Path(__file__).parents[2] / "mjcf"
_GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
_DURATION, _CONTROL_SHARE = 1.0, 0.5  # of recorded rollouts: s, and of the range of the controls
_HOLD = 10  # steps for which a control is held
_VELOCITY_STDDEV = 0.5  # of the start (m/s or rad/s)
_EPSILON_STEPS = 4  # roundings by which starts are moved, to see what rounding alone changes
_Starts = tuple[jax.Array, jax.Array, jax.Array]


@dataclass(frozen=True)
class _Program:
    """A compiled program and what it cost to make."""

    run: Callable[..., Any]
    text: str
    seconds: float
    flops: float


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Time every variant of every scene, and compare motions and gradients."""
    scenes = []
    # Compile times are measured, so none may come from an earlier run.
    had_cache = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        with workspace.stage("variants", "scenes", len(settings.chosen)) as advance_to:
            for number, name in enumerate(settings.chosen):
                scenes.append(workspace.once(name, functools.partial(_scene, name, settings, workspace)))
                advance_to(number + 1)
    finally:
        jax.config.update("jax_enable_compilation_cache", had_cache)
    return Outcome(settings, scenes)


def _scene(name: str, settings: Settings, workspace: Workspace) -> SceneOutcome:
    sizes, path = settings.sizes, scene_path(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        everything = mg.load_scene(path, keep_everything=True)
    workspace.check(everything)
    recorded, others = (
        record(
            everything, num_rollouts=sizes.num_recorded, duration=_DURATION, least_steps=2 * sizes.horizon, seed=seed
        )
        for seed in (settings.seed, settings.seed + 1)
    )
    found = variants(path, recorded)
    starts = segments(recorded, batch=sizes.batch, horizon=sizes.horizon, seed=settings.seed)
    # Compile times are measured, so Python keeps a core to itself.
    with ThreadPoolExecutor(num_compilers(besides=1)) as pool:
        motions = _Programs(found, _motion, starts, pool)
        # Of the same motion, letter for letter, the gradient is taken to be the same: what is left out has no derivative rule of
        # its own, which alone the text would not show.
        other = [v for v in found[1:] if not motions.is_same(v)] if sizes.has_every_gradient else []
        chosen = (EVERYTHING, FUSED, NEEDED, REACHED, *(v.name for v in other))
        gradients = _Programs([v for v in found if v.name in chosen], _gradient, starts, pool)
        # XLA leaves Python to this meanwhile.
        checks = {
            v.name: [mg.check_omissions(v.scene, seen) for seen in (recorded, others)]
            for v in found
            if v.name in (NEEDED, REACHED)
        }
    # All have been compiled, so that nothing else runs while they are timed.
    steps, slopes = motions.compare(sizes.repeats), gradients.compare(sizes.repeats)
    outcomes = [
        VariantOutcome(**vars(v), step=steps[v.name], gradient=slopes.get(v.name), checks=checks.get(v.name, ()))
        for v in found
    ]
    return SceneOutcome(name, outcomes, sizes.batch * sizes.horizon)


def scene_path(name: str) -> Path:
    """Give the MJCF file of a scene: ours, or gymnasium's."""
    own = _OWN / f"{name}.xml"
    return own if own.exists() else _GYMNASIUM / f"{name}.xml"


def record(scene: mg.Scene, *, num_rollouts: int, duration: float, least_steps: int, seed: int) -> mg.Trajectory:
    """Roll out random controls, held for a few steps, from the reference pose with random velocities, by C MuJoCo.

    Each takes its duration (s), or so many steps at least, and controls over half of their range, about its middle. C MuJoCo
    needs no compilation.
    """
    model = scene.to_mujoco()
    random = np.random.default_rng(seed)
    horizon = max(round(duration / model.opt.timestep), least_steps)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    middle, reach = (low + high) / 2, _CONTROL_SHARE * (high - low) / 2
    data, nq = mujoco.MjData(model), model.nq
    # Time, positions, velocities, and the state of actuators, if there is any.
    initial = np.zeros((num_rollouts, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    initial[:, 1 : 1 + nq] = data.qpos
    controls = []
    for start in initial:
        start[1 + nq : 1 + nq + model.nv] = _VELOCITY_STDDEV * random.normal(size=model.nv)
        held = middle + reach * random.uniform(-1, 1, (-(-horizon // _HOLD), model.nu))
        controls.append(np.repeat(held, _HOLD, axis=0)[:horizon])
    states = np.asarray(mujoco.rollout.rollout(model, data, initial, np.array(controls))[0])
    states = np.concatenate([initial[:, None], states], axis=1)

    def trajectory(qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> mg.Trajectory:
        bad, final = jnp.array(-1, jnp.int32), mg.initial_state(scene)
        return mg.Trajectory(qpos, qvel, ctrl, observations=None, final=final, diverged=bad >= 0, first_bad_step=bad)

    parts = (states[..., 1 : 1 + nq], states[..., 1 + nq : 1 + nq + model.nv], np.array(controls))
    return jax.vmap(trajectory)(*map(jnp.asarray, parts))


def segments(recorded: mg.Trajectory, *, batch: int, horizon: int, seed: int) -> _Starts:
    """Draw positions and velocities from recorded rollouts, with the controls that followed, one row per start."""
    random = np.random.default_rng(seed)
    which = random.integers(len(recorded.qpos), size=batch)
    when = random.integers(recorded.ctrl.shape[1] - horizon, size=batch)
    follow = when[:, None] + np.arange(horizon)
    return recorded.qpos[which, when], recorded.qvel[which, when], recorded.ctrl[which[:, None], follow]


def _motion(scene: mg.Scene) -> Callable[..., Any]:
    def states(qpos: jax.Array, qvel: jax.Array, controls: jax.Array) -> Any:
        trajectory = mg.rollout(scene, mg.initial_state(scene, qpos, qvel), controls)
        return trajectory.qpos, trajectory.qvel

    return states


def _gradient(scene: mg.Scene) -> Callable[..., Any]:
    weights = jnp.linspace(1.0, 2.0, scene.model.nq), jnp.linspace(-1.0, 1.0, scene.model.nv)

    def cost(qpos: jax.Array, qvel: jax.Array, controls: jax.Array) -> jax.Array:
        final = mg.rollout(scene, mg.initial_state(scene, qpos, qvel), controls).final
        # No symmetry, so that no error cancels.
        return weights[0] @ final.qpos + 0.1 * weights[1] @ final.qvel

    return jax.grad(cost, argnums=(0, 1, 2))


class _Programs:
    """One program of every variant; where two make the same, letter for letter, it is compiled and timed once.

    Compilation goes on in the threads of the pool after the return.
    """

    def __init__(
        self, found: list[Variant], make: Callable[[mg.Scene], Callable[..., Any]], starts: _Starts, pool: Executor
    ):
        self._starts = starts
        self._texts: dict[str, str] = {}
        self._by_text: dict[str, Future[_Program]] = {}
        for variant in found:
            lowered, seconds = _timed(lambda v=variant: jax.jit(jax.vmap(make(v.scene))).lower(*starts))
            text = self._texts[variant.name] = lowered.as_text()
            if text not in self._by_text:
                self._by_text[text] = pool.submit(_compiled, lowered, text, seconds)

    def is_same(self, variant: Variant) -> bool:
        """Whether a variant makes the same program as the scene with everything."""
        return self._texts[variant.name] == self._texts[EVERYTHING]

    def compare(self, repeats: int) -> dict[str, Cost]:
        """Let the programs take turns, and compare what they give with the first one's."""
        starts, by_text = self._starts, {text: future.result() for text, future in self._by_text.items()}
        results = {text: _numbers(program.run(*starts)) for text, program in by_text.items()}
        times: dict[str, list[float]] = {text: [] for text in by_text}
        for _ in range(repeats):
            for text, program in by_text.items():
                times[text].append(_timed(lambda p=program: jax.block_until_ready(p.run(*starts)))[1])
        first = by_text[self._texts[EVERYTHING]]
        base = results[first.text]
        rounding = np.abs(_numbers(first.run(*_rounded(starts))) - base).max(initial=0.0)
        return {
            name: Cost(
                seconds=np.array(times[text]),
                base_seconds=np.array(times[first.text]),
                compile_seconds=by_text[text].seconds,
                base_compile_seconds=first.seconds,
                flops=by_text[text].flops,
                base_flops=first.flops,
                is_same_program=text == first.text,
                difference=float(np.abs(results[text] - base).max(initial=0.0)),
                rounding=float(rounding),
                scale=float(np.abs(base).max(initial=0.0)),
            )
            for name, text in self._texts.items()
        }


def _compiled(lowered: jax.stages.Lowered, text: str, traced_in: float) -> _Program:
    compiled, seconds = _timed(lowered.compile)
    flops = (compiled.cost_analysis() or {}).get("flops", np.nan)
    return _Program(compiled, text, traced_in + seconds, float(flops))


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    result = function()
    return result, time.perf_counter() - began


def _numbers(result: Any) -> np.ndarray:
    return np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in jax.tree.leaves(result)])


def _rounded(starts: _Starts) -> _Starts:
    """Starts moved by a few roundings, some up, some down."""
    random = np.random.default_rng(0)

    def moved(x: jax.Array) -> jax.Array:
        signs = random.choice([-1.0, 1.0], size=x.shape)
        return x * (1 + _EPSILON_STEPS * np.finfo(np.asarray(x).dtype).eps * signs)

    return moved(starts[0]), moved(starts[1]), starts[2]
