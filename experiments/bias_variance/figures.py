"""The pictures of a bias and variance experiment."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.ticker import FixedLocator, NullLocator

from experiments.bias_variance.outcome import Interval, Outcome
from experiments.bias_variance.problems import problem, wall_contact
from experiments.theme import DEFAULT, FIRST, MUTED, REFERENCE, ZEROTH, Drawings, power, shades, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.workspace import Workspace

UNIT = "1/s²"


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"landscape": landscape, "gradient": gradient, "bias_variance": bias_variance, "choice": choice}


def landscape(outcome: Outcome):
    """Cost against angle for each stiffness, without noise and under it."""
    figure, axes = subplots(1, 2, height=4.0, sharey=True)
    shown = (
        (axes[0, 0], outcome.grid, outcome.cost, "Without noise"),
        (axes[0, 1], outcome.smooth_grid, outcome.smoothed, f"Mean under noise of {outcome.settings.stddev:g} rad"),
    )
    for axis, grid, costs, title in shown:
        swept = outcome.swept
        for colour, stiffness, cost in zip(shades(swept.stop), outcome.stiffness[swept], costs[swept], strict=True):
            axis.plot(grid, cost, color=colour, lw=1.3, label=power(stiffness))
        if outcome.has_default:
            axis.plot(grid, costs[-1], color=DEFAULT, lw=1.3, ls=(0, (4, 1.5)), label="default")
        for angle in outcome.angles:
            axis.axvline(angle, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        axis.set(title=title, xlabel="angle of the throw, rad", xlim=outcome.smooth_grid[[0, -1]])
    # The landscape goes on to both sides, where costs that nobody sees would set the scale.
    seen = outcome.cost[:, (outcome.grid >= outcome.smooth_grid[0]) & (outcome.grid <= outcome.smooth_grid[-1])]
    low, high = np.nanmin(seen), np.nanmax(seen)
    axes[0, 0].set_ylim(low - 0.04 * (high - low), high + 0.06 * (high - low))
    axes[0, 0].set_ylabel("cost, m²")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", title=f"stiffness, {UNIT}")
    caption = (
        "Left, one rollout per angle: where a blocked throw becomes one that clears the wall the cost jumps, and the stiffer "
        "the wall the sharper. Right, what noise makes of it, and what both estimates are to differentiate. Dotted lines mark "
        "the angles examined below."
    )
    return figure, "The cost against the angle of the throw", caption


def gradient(outcome: Outcome):
    """Means of both estimates and the reference against stiffness, one panel per angle."""
    figure, axes = _panels(outcome, rows=1, height=3.3)
    for j, axis in enumerate(axes[0]):
        axis.axhline(0, color=MUTED, lw=0.8)
        swept, reference = outcome.swept, outcome.reference
        low, high = reference.low[swept, j], reference.high[swept, j]
        axis.fill_between(outcome.stiffness[swept], low, high, color=REFERENCE, alpha=0.15, lw=0)
        _bars(axis, outcome, reference, j, REFERENCE, "_", "reference")
        _bars(axis, outcome, outcome.zeroth, j, ZEROTH, "s", "zeroth order", shift=1.06)
        _bars(axis, outcome, outcome.first, j, FIRST, "o", "first order", shift=1 / 1.06)
        _robust_limits(axis, outcome, j)
    axes[0, 0].set_ylabel("gradient, m²/rad")
    _legend(figure, axes)
    percent = f"{outcome.settings.confidence:.0%}"
    default = " The diamond on the dashed line is MuJoCo's default contact." if outcome.has_default else ""
    caption = (
        f"Mean of {outcome.settings.num_samples} samples with its {percent} interval, at each angle. The reference comes from "
        f"rollouts of its own; the grey band is its interval. Intervals that leave a panel are cut.{default}"
    )
    return figure, "Both estimates against the truth", caption


def bias_variance(outcome: Outcome):
    """Bias of the first-order estimate above, variance of both below, one column per angle."""
    figure, axes = _panels(outcome, rows=2, height=5.4)
    typical = np.median(outcome.bias.high - outcome.bias.low) / 2
    threshold = max(typical, 1e-12)
    extreme = np.nanmax(np.abs([outcome.bias.low, outcome.bias.high]))
    for j, (above, below) in enumerate(axes.T):
        above.axhline(0, color=MUTED, lw=0.8)
        _bars(above, outcome, outcome.bias, j, FIRST, "o", "bias of first order")
        chance = ~outcome.is_biased[:, j]
        x, y = outcome.stiffness[chance], outcome.bias.value[chance, j]
        above.plot(x, y, "o", ms=5, mfc="white", mec=FIRST, zorder=3)
        above.set_yscale("symlog", linthresh=threshold)
        above.set_ylim(-2 * extreme, 2 * extreme)
        _symlog_ticks(above, threshold, extreme)
        _bars(below, outcome, outcome.zeroth_variance, j, ZEROTH, "s", "zeroth order")
        _bars(below, outcome, outcome.first_variance, j, FIRST, "o", "first order")
        below.set_yscale("log")
    axes[0, 0].set_ylabel("bias of first order, m²/rad")
    axes[1, 0].set_ylabel("variance of one sample, (m²/rad)²")
    _legend(figure, axes[1:])
    percent = f"{outcome.settings.confidence:.0%}"
    default = " The diamond on the dashed line is MuJoCo's default contact." if outcome.has_default else ""
    caption = (
        f"Above, the mean of the first-order estimate less the reference, with the {percent} interval of the difference; "
        "filled where it differs from zero beyond chance over all cases, hollow where it does not. Below, the variance of a "
        f"single sample, with {percent} bootstrap intervals.{default}"
    )
    return figure, "Bias and variance", caption


def choice(outcome: Outcome):
    """Ratio of expected errors within the budget, for each stiffness and angle."""
    figure, axes = subplots(1, 1, height=0.55 * len(outcome.angles) + 1.6)
    axis = axes[0, 0]
    ratio = np.log10(outcome.first_error / outcome.zeroth_error).T
    bound = max(0.3, np.nanmax(np.abs(ratio)))
    colours = LinearSegmentedColormap.from_list("choice", [FIRST, "#f7f7f5", ZEROTH])
    # One tone per winner: where first order wins its own colour shows.
    axis.imshow(ratio, cmap=colours, vmin=-bound, vmax=bound, aspect="auto")
    for j, i in np.ndindex(ratio.shape):
        marks = ("*" if outcome.is_biased[i, j] else "") + ("†" if outcome.has_wrong_sign[i, j] else "")
        strong = abs(ratio[j, i]) > 0.6 * bound
        text = f"{10 ** ratio[j, i]:.2g}{marks}"
        axis.text(i, j, text, ha="center", va="center", fontsize=9, color="white" if strong else REFERENCE)
    names = [power(stiffness) for stiffness in outcome.stiffness[outcome.swept]]
    if outcome.has_default:
        names.append("default")
        axis.axvline(outcome.swept.stop - 0.5, color="white", lw=6)
    axis.set_xticks(range(len(names)), names)
    axis.set_yticks(range(len(outcome.angles)), [f"{angle:g}" for angle in outcome.angles])
    axis.set(xlabel=f"contact stiffness, {UNIT}", ylabel="angle, rad")
    axis.set_title(
        f"Expected error with {outcome.settings.rollouts_per_gradient} rollouts: first order over zeroth order"
    )
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    caption = (
        f"Root of squared bias plus variance over {outcome.settings.rollouts_per_gradient}, of first order divided by that of "
        "zeroth order: orange, and below 1, where first order is closer to the truth, blue where zeroth order is. A bias "
        "counts where it is beyond chance (*); † marks the wrong sign."
    )
    return figure, "Which estimate is closer", caption


def video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw the throws that the settings ask for, and give the file and its caption; nothing if there are none."""
    wanted, task = outcome.settings.video, problem(outcome.settings).task
    if wanted is None or task is None:
        return None, ""
    only_swept = outcome.settings.model_copy(update={"include_default": False})
    knob = wall_contact(task, np.asarray(wanted.stiffness), only_swept)
    mj_model = with_coarse_shadows(task.scene.mj_model)

    @jax.jit
    def throw(softness, angles):
        thrown = task.with_softness(softness)
        return jax.vmap(lambda angle: thrown.trajectory(angle[None]).qpos)(angles)

    motions = [
        (mj_model, qpos)
        for i in range(len(wanted.stiffness))
        for qpos in throw(jax.tree.map(lambda leaf, i=i: leaf[i], knob), jnp.asarray(wanted.angles))
    ]
    titles = [f"{angle:g} rad, stiffness {power(k)} 1/s²" for k in wanted.stiffness for angle in wanted.angles]
    caption = f"Throws without noise, by angle (columns) and stiffness of the wall (rows), {shown_speed(wanted.speed)}."
    return film(workspace, motions, wanted, camera="side", caption=caption, titles=titles, columns=len(wanted.angles))


def _panels(outcome: Outcome, *, rows: int, height: float):
    sharey = "row" if rows > 1 else False
    figure, axes = subplots(rows, len(outcome.angles), height=height, sharex=True, sharey=sharey)
    first, last = np.log10(outcome.stiffness[outcome.swept][[0, -1]])
    step = 1 if last - first <= 3 else 2
    ticks = 10.0 ** np.arange(np.ceil(first - 1e-9), last + 1e-9, step)
    for axis in axes.flat:
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(FixedLocator(ticks))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.set_xticks(ticks, [power(tick) for tick in ticks])
        if outcome.has_default:
            axis.axvline(outcome.stiffness[-1], color=MUTED, lw=1.0, ls=(0, (4, 3)), zorder=0)
    for axis, angle in zip(axes[0], outcome.angles, strict=True):
        axis.set_title(f"{angle:g} rad")
    if outcome.has_default:
        axes[0, 0].annotate(
            "default",
            (outcome.stiffness[-1], 1),
            xycoords=("data", "axes fraction"),
            xytext=(3, -2),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color=MUTED,
        )
    figure.supxlabel(f"contact stiffness, {UNIT}", fontsize=9.5, color="#3b4452")
    return figure, axes


def _bars(axis: Axes, outcome: Outcome, interval: Interval, j: int, colour, marker, label, shift: float = 1.0) -> None:
    """Draw an interval against stiffness: the sweep as a line, the default as a point beside it."""
    value = interval.value[:, j]
    # An interval's end may stand on the wrong side of its value by rounding alone.
    errors = np.maximum([value - interval.low[:, j], interval.high[:, j] - value], 0)
    x, swept, rest = outcome.stiffness * shift, outcome.swept, slice(outcome.swept.stop, None)
    look = {"color": colour, "ms": 5, "elinewidth": 1.2, "capsize": 2.5}
    axis.errorbar(x[swept], value[swept], errors[:, swept], marker=marker, lw=1.2, label=label, **look)
    axis.errorbar(x[rest], value[rest], errors[:, rest], marker="D", ls="", **look)


def _robust_limits(axis: Axes, outcome: Outcome, j: int) -> None:
    """Keep one wild interval of a stiff contact from flattening all others."""
    ends = np.concatenate(
        [
            outcome.reference.low[:, j],
            outcome.reference.high[:, j],
            outcome.zeroth.low[:, j],
            outcome.zeroth.high[:, j],
            outcome.first.value[:, j],
            [0.0],
        ]
    )
    ends = ends[np.isfinite(ends)]
    margin = 0.15 * (ends.max() - ends.min() or 1.0)
    axis.set_ylim(ends.min() - margin, ends.max() + margin)
    axis.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4), useMathText=True)


def _symlog_ticks(axis: Axes, threshold: float, extreme: float) -> None:
    decades = 10.0 ** np.arange(np.ceil(np.log10(threshold)), np.floor(np.log10(2 * extreme)) + 1)
    decades = decades[:: max(1, len(decades) // 3)]
    ticks = [*(-decades[::-1]), 0.0, *decades]
    axis.yaxis.set_major_locator(FixedLocator(ticks))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_yticks(ticks, ["0" if t == 0 else ("−" if t < 0 else "") + power(abs(t)) for t in ticks])


def _legend(figure, axes) -> None:
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
