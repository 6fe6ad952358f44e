"""The pictures of an experiment on leaving out."""

from collections.abc import Sequence

import numpy as np
from matplotlib.lines import Line2D

from experiments.ablation.measure import Outcome, SceneOutcome, VariantOutcome
from experiments.ablation.variants import NEEDED, REACHED
from experiments.parallel import num_compilers
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots

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
