"""The answer of an experiment on leaving out in words, computed from its numbers."""

import numpy as np

from experiments.ablation.figures import draw
from experiments.ablation.outcome import Cost, Outcome, SceneOutcome, VariantOutcome
from experiments.ablation.variants import EVERYTHING, NEEDED, REACHED
from experiments.report import Report, Table
from experiments.words import joined
from experiments.workspace import Workspace

_WORTH = 0.95  # of the time with everything: what the upper quartile must stay below to be called faster


def report(outcome: Outcome, workspace: Workspace) -> Report:
    """Draw the outcome, and say what follows from it."""
    return Report(
        verdict=verdict(outcome),
        findings=findings(outcome),
        figures=draw(outcome, workspace.folder),
        tables=tables(outcome),
        metrics=outcome.rows(),
    )


def verdict(outcome: Outcome) -> str:
    """Say what leaving out gains, and whether it changes anything."""
    sentences = [_gain(outcome, NEEDED, "what no motion needs"), _safety(outcome)]
    if any(scene.find(REACHED) for scene in outcome.scenes):
        sentences.append(_gain(outcome, REACHED, "what recorded motions did not reach, either"))
        sentences.append(_generalisation(outcome))
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence for each group."""
    names = dict.fromkeys(v.name for scene in outcome.scenes for v in scene.variants)
    groups = [name for name in names if name not in (EVERYTHING, NEEDED, REACHED)]
    return [*(_group(outcome, name) for name in groups), *_missed(outcome)]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the scenes with everything, and every group beside them."""
    return [_scenes(outcome), _groups(outcome)]


def _gain(outcome: Outcome, name: str, subject: str) -> str:
    having = [(scene, v) for scene in outcome.scenes if (v := scene.find(name))]
    same = [scene.name for scene, v in having if v.is_same_program]
    other = [(scene, v) for scene, v in having if not v.is_same_program]
    sentences = []
    if other:
        times = ", ".join(
            f"{scene.name} {_percent(v.step)} %" + (f", its gradient {_percent(v.gradient)} %" if v.gradient else "")
            for scene, v in sorted(other, key=lambda one: one[1].step.ratio[1])
        )
        sentences.append(f"Without {subject} a step takes of its time with everything: {times}.")
    if same:
        sentences.append(f"Without {subject} XLA is given the same program, letter for letter, in {joined(same)}.")
    return " ".join(sentences)


def _safety(outcome: Outcome) -> str:
    safe = [(scene, scene.find(NEEDED)) for scene in outcome.scenes]
    changed = [scene.name for scene, v in safe if v is not None and not v.is_unchanged]
    if changed:
        return f"Motion or gradient change by more than rounding in {joined(changed)}."
    return "Motions and gradients stay the same, bit for bit or to rounding, in every scene."


def _generalisation(outcome: Outcome) -> str:
    having = [(scene, v) for scene in outcome.scenes if (v := scene.find(REACHED))]
    needed = [f"{scene.name} ({len(v.others.missed)})" for scene, v in having if v.others and not v.others.is_sound]
    if not needed:
        return "Other motions of the kind did not reach it either."
    return f"Other motions of the kind did reach some of it, as check_omissions says: {', '.join(needed)}."


def _group(outcome: Outcome, name: str) -> str:
    having = [(scene, v) for scene in outcome.scenes if (v := scene.find(name))]
    if all(v.is_same_program for _, v in having):
        where = joined([scene.name for scene, _ in having])
        return f"{name.capitalize()}: nothing to gain, for the program is the same without in {where}."
    real = [(scene, v) for scene, v in having if not v.is_same_program]
    changed = [(scene, v) for scene, v in real if not v.is_unchanged]
    faster = [scene.name for scene, v in real if v.step.ratio[2] < _WORTH]
    text = "; ".join(
        f"{scene.name} {v.what}, {100 * v.step.flops / v.step.base_flops:.0f} % of the operations, "
        f"{_percent(v.step)} % of the time"
        for scene, v in real
    )
    pays = (
        f"A step is faster beyond the spread in {joined(faster)}"
        if faster
        else "Nowhere is a step faster beyond the spread"
    )
    same = ". Motion and gradient are the same."
    if changed:
        same = (
            ". The motion is another one in "
            + joined([f"{scene.name} ({v.step.verdict})" for scene, v in changed])
            + "."
        )
    return f"Without {name}: {text}. {pays}{same}"


def _missed(outcome: Outcome) -> list[str]:
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
