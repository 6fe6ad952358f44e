"""What leaving out gains, in words, tables and a picture."""

from collections.abc import Sequence

import numpy as np
from matplotlib.lines import Line2D

from experiments.ablation.measure import NEEDED, REACHED, Cost, Outcome, SceneOutcome, VariantOutcome
from experiments.parallel import num_compilers
from experiments.report import Table
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots
from experiments.words import joined, percent


def answer(outcome: Outcome) -> str:
    """Say what leaving out what no motion needs saves of a step, and whether it changes anything."""
    safe = [variant for scene in outcome.scenes if (variant := scene.find(NEEDED)) is not None]
    saved = 1 - min((variant.step.ratio[1] for variant in safe if not variant.is_same_program), default=1.0)
    num_changed = sum(not variant.is_unchanged for variant in safe)
    changes = f"{num_changed} scene{'s' * (num_changed > 1)} change" if num_changed else "without it nothing changes"
    cost = f"up to {percent(saved)} of a step" if saved > 0 else "nothing"
    return f"What no motion needs costs {cost}; {changes}."


def verdict(outcome: Outcome) -> str:
    """Say what leaving out gains, and whether it changes anything."""
    gains = [
        _gain(outcome, NEEDED, "what no motion needs"),
        _gain(outcome, REACHED, "what recorded motions did not reach either"),
    ]
    safe = [(scene.name, scene.find(NEEDED)) for scene in outcome.scenes]
    changed = [name for name, v in safe if v is not None and not v.is_unchanged]
    safety = (
        f"Motion or gradient change by more than rounding in {joined(changed)}."
        if changed
        else "Without what no motion needs, motions and gradients stay the same, bit for bit or to rounding, in every scene."
    )
    return " ".join([*filter(None, gains), safety])


def _gain(outcome: Outcome, name: str, subject: str) -> str:
    having = [
        (v.step.ratio[1], scene.name) for scene in outcome.scenes if (v := scene.find(name)) and not v.is_same_program
    ]
    if not having:
        return ""
    ends = [f"{percent(share)} of its time with everything in {scene}" for share, scene in (min(having), max(having))]
    others = (
        f" and {ends[1]}; {len(having)} of {len(outcome.scenes)} scenes have something of it" if len(having) > 1 else ""
    )
    return f"Without {subject}, a step takes {ends[0]}{others}."


def findings(outcome: Outcome) -> list[str]:
    """Say what other motions reached of what was left out."""
    sentences = []
    for scene in outcome.scenes:
        for variant in scene.variants:
            check = variant.checks[1] if variant.checks else None
            if check is None or check.is_sound:
                continue
            first = check.missed[0]
            sentences.append(
                f"{scene.name}, without {variant.name}: in other motions {first.what} acted first at {first.time:.2f} s, in "
                f"{first.num_states} of {check.num_states} states; in one step a number changes by up to {check.step_error:.2g}."
            )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the scenes with everything, and every group beside them."""
    whole, groups, emphasised = [], [], set()
    for scene in outcome.scenes:
        base = scene.variants[0]
        times = [f"{1e6 * float(np.median(cost.seconds)) / scene.steps_per_run:.3g}" for cost in base.costs]
        compiling = [f"{cost.compile_seconds:.1f}" for cost in base.costs]
        whole.append([scene.name, str(len(base.scene.pairs)), str(base.num_rows), *times, *compiling])
        for variant in scene.variants[1:]:
            if not variant.is_unchanged:
                emphasised.add((len(groups), 8))
            groups.append([scene.name, variant.name, variant.what, *_cells(variant)])
    return [
        Table(
            ("scene", "pairs", "rows", "step, µs", "gradient, µs", "compile step, s", "compile gradient, s"),
            whole,
            "With everything. Time per step of one rollout in a batch, median; the gradient includes the motion. Compilation "
            "includes tracing.",
        ),
        Table(
            ("scene", "left out", "what", "rows", "operations, %", "step, %", "gradient, %", "compile, %", "motion, gradient",
             "missed in other motions"),
            groups,
            "In per cent of the scene with everything; times are medians over turns with their quartiles, compilation is that of "
            "the gradient where measured, once. Motion and gradient: the same program before XLA sees it, equal bit for bit, "
            "equal to what rounding the start makes of them, or the difference as a share of the largest number (bold).",
            frozenset(emphasised),
        ),
    ]  # fmt: skip


def _cells(variant: VariantOutcome) -> list[str]:
    rows, missed = str(variant.num_rows), str(len(variant.checks[1].missed) or "none") if variant.checks else ""
    if variant.is_same_program:
        return [rows, "100", "", "", "", "same program", missed]
    main = variant.costs[-1]
    return [
        rows,
        f"{100 * variant.step.flops / variant.step.base_flops:.0f}",
        _spread(variant.step),
        _spread(variant.gradient) if variant.gradient else "",
        f"{100 * main.compile_seconds / main.base_compile_seconds:.0f}",
        ", ".join(cost.verdict for cost in variant.costs),
        missed,
    ]


def _spread(cost: Cost) -> str:
    low, middle, high = (100 * x for x in cost.ratio)
    return f"{middle:.0f} ({low:.0f} to {high:.0f})"


_TITLES = ("Time of a step", "Time of a gradient", "Operations of a step", "Compile time")
_LOOKS = (
    (ZEROTH, "all that no motion needs"),
    (FIRST, "and what recorded motions did not reach"),
    (MUTED, "one group"),
)


def drawings(outcome: Outcome) -> Drawings:
    """Name the figure; none if every variant is the same program."""
    return {"ratios": ratios} if _drawn(outcome) else {}


def ratios(outcome: Outcome):
    """One line per scene and group, one panel per cost."""
    drawn = _drawn(outcome)
    figure, axes = subplots(1, 4, height=1.7 + 0.27 * len(drawn), sharey=True)
    for place, (_, variant) in enumerate(drawn):
        colour = _look(variant)[0]
        fill = colour if variant.is_unchanged else "white"
        for axis, (low, middle, high) in zip(axes[0], _shares(variant), strict=True):
            axis.plot([low, high], [place, place], color=colour, lw=2, solid_capstyle="round")
            axis.plot(middle, place, "o", color=colour, mfc=fill, ms=6)
    for axis, title in zip(axes[0], _TITLES, strict=True):
        axis.axvline(1.0, color=REFERENCE, lw=1)
        axis.set_title(title)
        axis.set_xlim(0, max(1.12, 1.03 * axis.get_xlim()[1]))
        axis.set_xlabel("share")
        axis.locator_params(axis="x", nbins=4)
    axes[0, 0].set_yticks(range(len(drawn)), [f"{scene.name}: {v.name}" for scene, v in drawn])
    axes[0, 0].set_ylim(len(drawn) - 0.5, -0.5)
    looks = {_look(variant) for _, variant in drawn}
    handles = [Line2D([], [], color=look[0], marker="o", ls="", label=look[1]) for look in _LOOKS if look in looks]
    if not all(variant.is_unchanged for _, variant in drawn):
        handles.append(Line2D([], [], color=MUTED, marker="o", mfc="white", ls="", label="changes motion or gradient"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
    sizes = outcome.settings.sizes
    caption = (
        f"Each as a share of the same scene with everything; left of the line is cheaper. Dots are medians of {sizes.repeats} "
        f"turns, bars their quartiles; compilation is that of the gradient, once, without a cache, {num_compilers(besides=1)} "
        "at a time while others are traced. Only variants that make another program are drawn: all others are the scene with "
        f"everything, letter for letter. Open dots: motion or gradient is another one. {sizes.batch} rollouts of "
        f"{sizes.horizon} steps, started along recorded motions."
    )
    return figure, "Cost without, as a share of the cost with everything", caption


def _drawn(outcome: Outcome) -> list[tuple[SceneOutcome, VariantOutcome]]:
    return [(scene, v) for scene in outcome.scenes for v in scene.variants[1:] if not v.is_same_program]


def _look(variant: VariantOutcome) -> tuple[str, str]:
    places = {NEEDED: 0, REACHED: 1}
    return _LOOKS[places.get(variant.name, 2)]


def _shares(variant: VariantOutcome) -> list[Sequence[float]]:
    """Give what each panel shows: lower end, dot and upper end; NaN where it was not measured."""
    step, gradient, unknown = variant.step, variant.gradient, (np.nan,) * 3
    return [
        step.ratio,
        gradient.ratio if gradient else unknown,
        (step.flops / step.base_flops,) * 3,
        (gradient.compile_seconds / gradient.base_compile_seconds,) * 3 if gradient else unknown,
    ]
