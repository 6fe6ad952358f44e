"""From settings to numbers."""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mjxgrad as mg
from experiments.ablation.outcome import Cost, Outcome, SceneOutcome, VariantOutcome
from experiments.ablation.recording import record, scene_path, segments
from experiments.ablation.settings import AblationSettings
from experiments.ablation.variants import EVERYTHING, FUSED, NEEDED, REACHED, Variant, variants
from experiments.parallel import in_threads
from experiments.workspace import Workspace

_EPSILON_STEPS = 4  # roundings by which starts are moved, to see what rounding alone changes
_Starts = tuple[jax.Array, jax.Array, jax.Array]


@dataclass(frozen=True)
class _Program:
    """A compiled program and what it cost to make."""

    run: Callable[..., Any]
    text: str
    seconds: float
    flops: float


def measure(settings: AblationSettings, workspace: Workspace) -> Outcome:
    """Time every variant of every scene, and compare motions and gradients.

    Args:
        settings: of the run.
        workspace: for the clock.

    Returns:
        The numbers.
    """
    scenes = []
    # Compile times are measured, so none may come from an earlier run.
    had_cache = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        with workspace.stage("variants", "scenes", len(settings.chosen)) as advance_to:
            for number, name in enumerate(settings.chosen):
                scenes.append(_scene(name, settings, workspace))
                advance_to(number + 1)
    finally:
        jax.config.update("jax_enable_compilation_cache", had_cache)
    return Outcome(settings, scenes)


def _scene(name: str, settings: AblationSettings, workspace: Workspace) -> SceneOutcome:
    sizes, path = settings.sizes, scene_path(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        everything = mg.load_scene(path, keep_everything=True)
    workspace.check(everything)
    recorded, others = (
        record(
            everything,
            num_rollouts=sizes.num_recorded,
            duration=settings.duration,
            control_share=settings.control_share,
            seed=settings.seed + i,
        )
        for i in range(2)
    )
    found = variants(path, recorded, settings.beyond_limits)
    starts = segments(recorded, batch=sizes.batch, horizon=sizes.horizon, seed=settings.seed)
    wanted = [v for v in found if sizes.has_every_gradient or v.name in (EVERYTHING, FUSED, NEEDED, REACHED)]
    steps = _compare(found, _motion, starts, sizes.repeats)
    gradients = _compare(wanted, _gradient, starts, sizes.repeats)
    outcomes = []
    for variant in found:
        checks = [None, None]
        if variant.name in (NEEDED, REACHED):
            checks = [mg.check_omissions(variant.scene, seen) for seen in (recorded, others)]
        outcomes.append(
            VariantOutcome(
                name=variant.name,
                what=variant.what,
                num_pairs=len(variant.scene.pairs),
                num_rows=int(variant.scene.data._impl.nefc),
                num_bodies=int(variant.scene.model.nbody),
                step=steps[variant.name],
                gradient=gradients.get(variant.name),
                recorded=checks[0],
                others=checks[1],
            )
        )
    return SceneOutcome(name, outcomes, sizes.batch * sizes.horizon)


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


def _compare(
    found: list[Variant], make: Callable[[mg.Scene], Callable[..., Any]], starts: _Starts, repeats: int
) -> dict[str, Cost]:
    """Compile all variants, let them take turns, and compare what they give with the first one's.

    Where two variants make the same program, letter for letter, it is compiled and timed once: nothing could differ.
    """
    texts: dict[str, str] = {}
    lowered: dict[str, tuple[jax.stages.Lowered, float]] = {}
    for variant in found:
        program, seconds = _timed(lambda v=variant: jax.jit(jax.vmap(make(v.scene))).lower(*starts))
        texts[variant.name] = program.as_text()
        lowered.setdefault(texts[variant.name], (program, seconds))

    def finish(text: str) -> _Program:
        compiled, seconds = _timed(lowered[text][0].compile)
        return _Program(compiled, text, lowered[text][1] + seconds, _flops(compiled))

    by_text = dict(zip(lowered, in_threads(finish, lowered), strict=True))
    programs = {name: by_text[text] for name, text in texts.items()}
    results = {text: _numbers(program.run(*starts)) for text, program in by_text.items()}
    times: dict[str, list[float]] = {text: [] for text in by_text}
    for _ in range(repeats):
        for text, program in by_text.items():
            times[text].append(_timed(lambda p=program: jax.block_until_ready(p.run(*starts)))[1])
    first = programs[EVERYTHING]
    base = results[first.text]
    rounding = np.abs(_numbers(first.run(*_rounded(starts))) - base).max(initial=0.0)
    return {
        name: Cost(
            seconds=np.array(times[program.text]),
            base_seconds=np.array(times[first.text]),
            compile_seconds=program.seconds,
            base_compile_seconds=first.seconds,
            flops=program.flops,
            base_flops=first.flops,
            is_same_program=program.text == first.text,
            difference=float(np.abs(results[program.text] - base).max(initial=0.0)),
            rounding=float(rounding),
            scale=float(np.abs(base).max(initial=0.0)),
        )
        for name, program in programs.items()
    }


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    result = function()
    return result, time.perf_counter() - began


def _flops(compiled: Any) -> float:
    return float((compiled.cost_analysis() or {}).get("flops", np.nan))


def _numbers(result: Any) -> np.ndarray:
    return np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in jax.tree.leaves(result)])


def _rounded(starts: _Starts) -> _Starts:
    """Starts moved by a few roundings, some up, some down."""
    random = np.random.default_rng(0)

    def moved(x: jax.Array) -> jax.Array:
        signs = random.choice([-1.0, 1.0], size=x.shape)
        return x * (1 + _EPSILON_STEPS * np.finfo(np.asarray(x).dtype).eps * signs)

    return moved(starts[0]), moved(starts[1]), starts[2]
