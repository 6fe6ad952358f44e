"""The answer of an experiment on leaving out in words, computed from its numbers."""

import numpy as np

from experiments.ablation.outcome import Cost, Outcome, SceneOutcome, VariantOutcome
from experiments.ablation.variants import NEEDED, REACHED
from experiments.report import Table
from experiments.words import joined


def verdict(outcome: Outcome) -> str:
    """Say what leaving out gains, and whether it changes anything."""
    gains = [
        _gain(outcome, NEEDED, "what no motion needs"),
        _gain(outcome, REACHED, "what recorded motions did not reach, either"),
    ]
    return " ".join([*filter(None, gains), _safety(outcome)])


def findings(outcome: Outcome) -> list[str]:
    """Say what other motions reached of what was left out."""
    sentences = []
    for scene in outcome.scenes:
        for name in (NEEDED, REACHED):
            variant = scene.find(name)
            check = variant.others if variant else None
            if check is None or check.is_sound:
                continue
            first = check.missed[0]
            sentences.append(
                f"{scene.name}, without {name}: in other motions {first.what} acted first at {first.time:.2f} s, in "
                f"{first.num_states} of {check.num_states} states; in one step a number changes by up to {check.step_error:.2g}."
            )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the scenes with everything, and every group beside them."""
    return [_scenes(outcome), _groups(outcome)]


def _gain(outcome: Outcome, name: str, subject: str) -> str:
    having = [(scene, v) for scene in outcome.scenes if (v := scene.find(name)) and not v.is_same_program]
    if not having:
        return ""
    times = ", ".join(
        f"{scene.name} {_percent(v.step)} %" + (f", its gradient {_percent(v.gradient)} %" if v.gradient else "")
        for scene, v in sorted(having, key=lambda one: one[1].step.ratio[1])
    )
    return f"Without {subject} a step takes of its time with everything: {times}."


def _safety(outcome: Outcome) -> str:
    safe = [(scene, scene.find(NEEDED)) for scene in outcome.scenes]
    changed = [scene.name for scene, v in safe if v is not None and not v.is_unchanged]
    if changed:
        return f"Motion or gradient change by more than rounding in {joined(changed)}."
    return "Motions and gradients stay the same, bit for bit or to rounding, in every scene."


def _scenes(outcome: Outcome) -> Table:
    rows = []
    for scene in outcome.scenes:
        base = scene.variants[0]
        rows.append(
            [
                scene.name, str(base.num_pairs), str(base.num_rows),
                _microseconds(base.step, scene), _microseconds(base.gradient, scene),
                f"{base.step.compile_seconds:.1f}", f"{base.gradient.compile_seconds:.1f}" if base.gradient else "",
            ]
        )  # fmt: skip
    return Table(
        ("scene", "pairs", "rows", "step, µs", "gradient, µs", "compile step, s", "compile gradient, s"),
        rows,
        "With everything. Time per step of one rollout in a batch, median; the gradient includes the motion. Compilation "
        "includes tracing.",
    )


def _groups(outcome: Outcome) -> Table:
    rows, emphasised = [], set()
    for scene in outcome.scenes:
        for variant in scene.variants[1:]:
            if not variant.is_unchanged:
                emphasised.add((len(rows), 8))
            rows.append([scene.name, variant.name, variant.what, *_cells(variant)])
    return Table(
        ("scene", "left out", "what", "rows", "operations, %", "step, %", "gradient, %", "compile, %", "motion, gradient",
         "missed in other motions"),
        rows,
        "In per cent of the scene with everything; times are medians over turns with their quartiles, compilation is that of the "
        "gradient where measured, once. Motion and gradient: the same program before XLA sees it, equal bit for bit, equal "
        "to what rounding the start makes of them, or the difference as a share of the largest number (bold).",
        frozenset(emphasised),
    )  # fmt: skip


def _cells(variant: VariantOutcome) -> list[str]:
    main = variant.gradient or variant.step
    head = [str(variant.num_rows)]
    tail = [str(len(variant.others.missed) or "none") if variant.others else ""]
    if variant.is_same_program:
        return [*head, "100", "", "", "", "same program", *tail]
    return [
        *head,
        f"{100 * variant.step.flops / variant.step.base_flops:.0f}",
        _spread(variant.step),
        _spread(variant.gradient),
        f"{100 * main.compile_seconds / main.base_compile_seconds:.0f}",
        ", ".join(cost.verdict for cost in (variant.step, variant.gradient) if cost),
        *tail,
    ]


def _percent(cost: Cost) -> str:
    return f"{100 * cost.ratio[1]:.0f}"


def _spread(cost: Cost | None) -> str:
    if cost is None:
        return ""
    low, middle, high = (100 * x for x in cost.ratio)
    return f"{middle:.0f} ({low:.0f} to {high:.0f})"


def _microseconds(cost: Cost | None, scene: SceneOutcome) -> str:
    return f"{1e6 * float(np.median(cost.seconds)) / scene.steps_per_run:.3g}" if cost else ""
