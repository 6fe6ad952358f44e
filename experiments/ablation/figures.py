"""The pictures of an experiment on leaving out."""

from matplotlib.lines import Line2D

from experiments.ablation.outcome import Cost, Outcome, SceneOutcome, VariantOutcome
from experiments.ablation.variants import NEEDED, REACHED
from experiments.parallel import num_compilers
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots

_TITLES = ("time of a step", "time of a gradient", "operations of a step", "compile time")
_KINDS = {
    NEEDED: (ZEROTH, "all that no motion needs"),
    REACHED: (FIRST, "and what recorded motions did not reach"),
    None: (MUTED, "one group"),
}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figure; none if every variant is the same program."""
    return {"ratios": ratios} if _drawn(outcome) else {}


def ratios(outcome: Outcome):
    """One line per scene and group, one panel per cost."""
    drawn = _drawn(outcome)
    figure, axes = subplots(1, 4, height=1.7 + 0.27 * len(drawn), sharey=True)
    for place, (_, variant) in enumerate(drawn):
        for axis, (middle, low, high) in zip(axes[0], _shares(variant), strict=True):
            if middle is None:
                continue
            fill = _colour(variant) if variant.is_unchanged else "white"
            axis.plot([low, high], [place, place], color=_colour(variant), lw=2, solid_capstyle="round")
            axis.plot(middle, place, "o", color=_colour(variant), mfc=fill, ms=6)
    for axis, title in zip(axes[0], _TITLES, strict=True):
        axis.axvline(1.0, color=REFERENCE, lw=1)
        axis.set_title(title)
        axis.set_xlim(0, max(1.12, axis.get_xlim()[1]))
        axis.set_xlabel("share")
    axes[0, 0].set_yticks(range(len(drawn)), [f"{scene.name}: {v.name}" for scene, v in drawn])
    axes[0, 0].set_ylim(len(drawn) - 0.5, -0.5)
    kinds = {_kind(variant) for _, variant in drawn}
    handles = [
        Line2D([], [], color=colour, marker="o", ls="", label=label)
        for kind, (colour, label) in _KINDS.items()
        if kind in kinds
    ]
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


def _kind(variant: VariantOutcome) -> str | None:
    return variant.name if variant.name in _KINDS else None


def _colour(variant: VariantOutcome) -> str:
    return _KINDS[_kind(variant)][0]


def _shares(variant: VariantOutcome) -> list[tuple[float | None, float | None, float | None]]:
    operations = variant.step.flops / variant.step.base_flops
    compilation = None
    if variant.gradient is not None:
        compilation = variant.gradient.compile_seconds / variant.gradient.base_compile_seconds
    counted = (operations, operations, operations), (compilation, compilation, compilation)
    return [_of(variant.step), _of(variant.gradient), *counted]


def _of(cost: Cost | None) -> tuple[float | None, float | None, float | None]:
    if cost is None:
        return None, None, None
    low, middle, high = cost.ratio
    return middle, low, high
