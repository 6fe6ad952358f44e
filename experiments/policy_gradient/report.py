"""The answer of the experiment on policy gradients, computed from its numbers, and its pictures."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from experiments.policy_gradient.measure import DISCRETE, GRADIENTS, ONSET, Cell, Outcome, mean_and_error
from experiments.report import Table
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, legend_below, subplots
from experiments.words import joined, percent, quantity
from mjxgrad.estimators import Reason

NEGLIGIBLE = 0.05
"""Of the gradient's norm: a bias below it matters to no descent."""


def answer(outcome: Outcome) -> str:
    """Count where either first-order gradient is biased, among points without a jump of the cost if there are any."""
    smooth = [cell for cell in outcome.cells if not cell.hits_and_misses]
    if not smooth:
        biased = sum(_is_biased(cell, ONSET) for cell in outcome.cells)
        return f"It does not see hits and misses: biased at {biased} of {len(outcome.cells)} points."
    discrete, onset = (sum(_is_biased(cell, gradient) for cell in smooth) for gradient in (DISCRETE, ONSET))
    if not discrete and not onset:
        return f"First order is right with and without it, at all {len(smooth)} points."
    if onset < discrete:
        return f"It cuts the points with a biased gradient from {discrete} to {onset} of {len(smooth)}."
    return f"It does not help: {onset} of {len(smooth)} points are biased, {discrete} without it."


def verdict(outcome: Outcome) -> str:
    """Say where which first-order estimate is right."""
    smooth = [cell for cell in outcome.cells if not cell.hits_and_misses]
    repaired = [cell for cell in smooth if _is_biased(cell, DISCRETE) and _is_beyond(cell, DISCRETE, ONSET)]
    sentences = []
    if repaired:
        discrete, onset = ([cell.judged[gradient].bias for cell in repaired] for gradient in GRADIENTS)
        sentences.append(
            f"The discrete first-order gradient is biased at {len(repaired)} of {len(smooth)} points without a jump of the cost, "
            f"by {_span(discrete)} of the gradient's norm, where contact that begins within the step leaves {_span(onset)}."
        )
    worse = [cell for cell in smooth if _is_biased(cell, ONSET) and _is_beyond(cell, ONSET, DISCRETE)]
    sentences.append(
        f"Contact that begins within the step is worse in {joined([cell.label for cell in worse])}."
        if worse
        else "Nowhere is contact that begins within the step the worse of both beyond chance."
    )
    jumps = [cell for cell in outcome.cells if cell.hits_and_misses]
    missed = [cell for cell in jumps if _is_biased(cell, ONSET)]
    if missed:
        biases, alphas = zip(*((cell.judged[ONSET].bias, cell.judged[ONSET].alpha) for cell in missed), strict=True)
        sentences.append(
            f"Hit or miss it does not see: at {len(missed)} of {len(jumps)} points where the noise covers a jump it is biased by "
            f"{_span(biases)}, and α-order gives it a weight of {_span(alphas, '{:.2f}'.format)}."
        )
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say whether an onset does harm where contact sets in gently."""
    gentle = [cell for cell in outcome.cells if not cell.has_jump_of_force]
    if not gentle:
        return []
    cell = max(gentle, key=_change)
    return [
        f"Where contact sets in gently it changes the first-order mean by at most {percent(_change(cell))} of the "
        f"gradient ({cell.label})."
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate both gradients at every point."""
    rows, emphasised = [], set()
    for cell in outcome.cells:
        for gradient in GRADIENTS:
            if _is_biased(cell, gradient):
                emphasised.add((len(rows), 3))
            one = cell.judged[gradient]
            rows.append(
                [
                    cell.label if gradient == DISCRETE else "",
                    f"{cell.norm:.3g}" if gradient == DISCRETE else "",
                    gradient,
                    f"{one.bias:.1%} ({one.low:.1%} to {one.high:.1%})",
                    quantity(one.along, one.along_error),
                    quantity(one.alpha, one.alpha_error),
                    _reasons(cell, gradient),
                    *(f"{error:.1%}" for error in one[-3:]),
                ]
            )
    columns = (
        "task", "norm of the gradient", "derivative", "bias, first order", "component along", "α", "why (share of estimates)",
        "error, first order", "error, unbiased", "error, α-order",
    )  # fmt: skip
    caption = (
        "Bias and errors over the norm of the gradient. Bias: of the mean, noise taken off, in brackets two standard errors "
        "to either side; bold where it is not chance and above five per cent. Component along the reference: 1 is right. Errors: "
        "root mean square of one estimate."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _is_biased(cell: Cell, gradient: str) -> bool:
    """Say whether a bias is beyond chance, and worth speaking of."""
    return cell.judged[gradient].low > 0 and cell.judged[gradient].bias > NEGLIGIBLE


def _is_beyond(cell: Cell, larger: str, smaller: str) -> bool:
    return cell.judged[larger].low > cell.judged[smaller].high


def _change(cell: Cell) -> float:
    """How far apart both first-order means are, over the norm of the gradient; from the same rollouts."""
    onset, discrete = (cell.estimates[gradient].first.mean(axis=0) for gradient in (ONSET, DISCRETE))
    return float(np.linalg.norm(onset - discrete)) / cell.norm


def _reasons(cell: Cell, gradient: str) -> str:
    """Name the rule's reasons in a word each, with their shares."""
    words = {
        "inconsistent": "contradictory",
        "inverse_variance": "trusted",
        "bias_limit": "biased",
        "uncertain": "uncertain",
    }
    reasons = cell.estimates[gradient].reason
    shares = {word: float(np.mean(reasons == getattr(Reason, name)._value)) for name, word in words.items()}
    return ", ".join(f"{word} {share:.0%}" for word, share in shares.items() if share > 0)


def _span(values: Sequence[float], write: Callable[[float], str] = percent) -> str:
    return " to ".join(dict.fromkeys(map(write, (min(values), max(values)))))


_COLOURS = {DISCRETE: FIRST, ONSET: ZEROTH}
_MARKERS = {DISCRETE: "o", ONSET: "s"}
_SMALLEST = 1e-3
_THROWS = ("ball_wall", "ball_wall_default")


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"summary": summarised} | ({"throw": throw} if outcome.of(*_THROWS) else {})


def summarised(outcome: Outcome):
    """Three panels with one row per point: bias of the first order, α, error of one α-order estimate."""
    cells = outcome.cells
    figure, axes = subplots(1, 3, height=1.4 + 0.27 * len(cells), sharey=True)
    rows = np.arange(len(cells))
    for gradient, shift in ((DISCRETE, -0.14), (ONSET, 0.14)):
        look = {"color": _COLOURS[gradient], "marker": _MARKERS[gradient], "ls": "", "ms": 5}
        judged = [cell.judged[gradient] for cell in cells]
        bias, low, high = np.maximum(np.array([one[:3] for one in judged]).T, _SMALLEST)
        spread = np.abs(np.stack([bias - low, high - bias]))
        axes[0, 0].errorbar(bias, rows + shift, xerr=spread, label=f"{gradient} gradient", elinewidth=1, **look)
        alpha, alpha_error = np.array([(one.alpha, one.alpha_error) for one in judged]).T
        axes[0, 1].errorbar(alpha, rows + shift, xerr=2 * alpha_error, elinewidth=1, **look)
        axes[0, 2].plot([one.error_mixed for one in judged], rows + shift, **look)
    for axis in axes[0]:
        for row in rows[[cell.hits_and_misses for cell in cells]]:
            axis.axhspan(row - 0.5, row + 0.5, color=MUTED, alpha=0.18, lw=0)
        axis.grid(axis="y", visible=False)
    for axis in axes[0, ::2]:
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g}%")
        axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].set_xlim(left=_SMALLEST)
    axes[0, 1].set_xlim(-0.04, 1.04)
    axes[0, 0].set_yticks(rows, [cell.label for cell in cells])
    axes[0, 0].set_ylim(len(cells) - 0.5, -0.5)
    axes[0, 2].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes[0, 0].set(title="Bias of the first order", xlabel="share of the gradient")
    axes[0, 1].set(title="Weight of the first order", xlabel="α")
    axes[0, 2].set(title="Error of one α-order estimate", xlabel="share of the gradient")
    legend_below(figure, axes[0, 0], 2)
    caption = (
        "Left, norm of the bias over the norm of the gradient, noise taken off, with two standard errors; where the interval "
        "reaches the edge no bias was found. Middle, mean weight of the first order. Right, root-mean-square error of one "
        "estimate, over the norm of the gradient: the smaller, the fewer rollouts are needed. Shaded: the noise covers a jump "
        "of the cost."
    )
    return figure, "Bias, trust and error", caption


def throw(outcome: Outcome):
    """A row per contact: gradients against the angle, and α."""
    cells = outcome.of(*_THROWS)
    names = list(dict.fromkeys(cell.name for cell in cells))
    figure, axes = subplots(len(names), 2, height=0.6 + 2.7 * len(names), sharex=True, width_ratios=[1.6, 1])
    for (left, right), name in zip(axes, names, strict=True):
        shown = [cell for cell in cells if cell.name == name]
        angle = np.array([float(cell.point.split()[0]) for cell in shown])
        reference = np.array([mean_and_error(cell.reference) for cell in shown])[:, :, 0]
        left.errorbar(
            angle, reference[:, 0], 2 * reference[:, 1], color=REFERENCE, lw=2.2, capsize=3, label="unbiased reference"
        )
        for gradient, shift in ((DISCRETE, -0.006), (ONSET, 0.006)):
            look = {"color": _COLOURS[gradient], "marker": _MARKERS[gradient], "ms": 5, "lw": 1, "ls": (0, (4, 2))}
            first = np.array([mean_and_error(cell.estimates[gradient].first) for cell in shown])[:, :, 0]
            left.errorbar(
                angle + shift, first[:, 0], 2 * first[:, 1], label=f"first order, {gradient} gradient", **look
            )
            judged = [cell.judged[gradient] for cell in shown]
            spread = [2 * one.alpha_error for one in judged]
            right.errorbar(angle + shift, [one.alpha for one in judged], spread, **look)
        for axis in (left, right):
            for cell, place in zip(shown, angle, strict=True):
                if cell.hits_and_misses:
                    axis.axvspan(place - 0.05, place + 0.05, color=MUTED, alpha=0.18, lw=0)
        left.set_yscale("symlog", linthresh=0.01)
        left.yaxis.set_major_formatter("{x:g}")
        left.set(title=shown[0].title, ylabel="gradient, m²/rad")
        right.set(title="Weight of the first order", ylabel="α", ylim=(-0.05, 1.05))
    for axis in axes[-1]:
        axis.set_xlabel("angle, rad")
    legend_below(figure, axes[0, 0], 3)
    caption = (
        f"Left, gradient of the cost under noise of {outcome.settings.angle_stddev:g} rad; error bars are two standard errors. "
        "Right, weight of the first order in the α-order estimate. Shaded: between the first throws that clear the wall and the "
        "last that do not; there neither derivative sees the jump."
    )
    return figure, "Throws over the wall", caption
