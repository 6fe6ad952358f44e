"""The answer of a bias and variance experiment, computed from its numbers, and its pictures."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.ticker import NullLocator, SymmetricalLogLocator

import mjxgrad as mg
from experiments import theme
from experiments.bias_variance.measure import Outcome, wall_contact
from experiments.bias_variance.settings import ThrowsSettings
from experiments.report import Bold, Table, tabulated
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, power, subplots
from experiments.video import film, shown_speed, with_coarse_shadows
from experiments.words import joined, quantity
from experiments.workspace import Workspace


@dataclass(frozen=True)
class Words:
    """What the numbers of a problem are called."""

    knob: str  # what is swept
    per: str  # its unit, after a space; nothing if it has none
    place: str  # the parameter
    at: str  # its unit, likewise
    cost: str  # with its unit
    gradient: str  # unit of the gradient, after a comma
    variance: str  # of its variance, likewise
    shown: str  # what the landscape shows
    limit: str  # what is swept, in a word
    drawings: tuple[str, ...]  # in order of reading, the one that answers first
    lead: str = ""  # before a value of what is swept


_WORDS = {
    "ball_wall": Words(
        "contact stiffness", " 1/s²", "angle", " rad", "cost, m²", ", m²/rad", ", (m²/rad)²",
        "where a blocked throw becomes one that clears the wall the cost jumps, and the stiffer the wall the sharper",
        "stiffness", ("choice", "landscape", "gradient", "bias_variance"),
    ),
    "ramp": Words(
        "slope of the ramp", "", "parameter", "", "cost", "", "", "a ramp from −1 to 1, and the steeper the more it is a step",
        "slope", ("gradient", "landscape", "bias_variance", "choice"), "slope ",
    ),
    "own": Words(
        "contact stiffness", " 1/s²", "control", " half ranges", "cost", ", cost per half range", ", its square", "",
        "stiffness", ("bias_variance", "gradient", "choice"),
    ),
}  # fmt: skip


def _words(outcome: Outcome) -> Words:
    return _WORDS[outcome.settings.problem]


def _titled(name: str, unit: str) -> str:
    """Name an axis."""
    return f"{name},{unit}" if unit else name


def answer(outcome: Outcome) -> str:
    """Say where each estimate is right: where its mean does not differ from the reference beyond chance."""
    swept, words = outcome.swept, _words(outcome)
    is_off = swept.zeroth_is_off
    zeroth = "throughout" if not is_off.any() else f"at {int((~is_off).sum())} of {is_off.size} points"
    biased, is_blind = _bias_seen(swept)
    is_wrong = (biased | is_blind).values
    if not is_wrong.any():
        return f"Zeroth order is right {zeroth}; first order shows no bias either."
    if is_wrong[0]:
        return f"Zeroth order is right {zeroth}; first order at no {words.knob}."
    last = swept.stiffness.values[is_wrong.argmax() - 1]
    return f"Zeroth order is right {zeroth}; first order only up to {words.limit} {power(last)}{words.per}."


def _bias_seen(swept: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    """Say at which stiffness first order is biased somewhere, and at which it is too noisy to tell."""
    biased = swept.is_biased.any("angle")
    # No bias seen is no bias only where one of half the gradient's own size would have been seen.
    half_width = (swept.bias_high - swept.bias_low) / 2
    return biased, (half_width > abs(swept.reference).max("stiffness") / 2).any("angle") & ~biased


def verdict(outcome: Outcome) -> str:
    """Say where each estimate is to be used."""
    choice = f"With {outcome.settings.rollouts_per_gradient} rollouts per gradient {_choice(outcome.swept, _words(outcome))}."
    return " ".join([choice, *_default(outcome)])


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate both estimates, the reference and which estimate to use."""
    table, words, rows = outcome.table, _words(outcome), []
    for i, j in np.ndindex(table.bias.shape):
        one = table.isel(stiffness=i, angle=j)
        row = f"default ({power(float(one.stiffness))})" if one.is_default else power(float(one.stiffness))
        rows.append(
            {
                _titled(words.knob, words.per): row if j == 0 else "",
                _titled(words.place, words.at): f"{float(one.angle):g}",
                "first order": f"{_with_half_width(one, 'first_order')}{' †' if one.has_wrong_sign else ''}",
                "zeroth order": _with_half_width(one, "zeroth_order"),
                "reference": _with_half_width(one, "reference"),
                "bias of first order": (Bold if one.is_biased else str)(_with_half_width(one, "bias")),
                "variance ratio": quantity(float(one.first_order_variance / one.zeroth_order_variance)),
                "use": "first" if one.first_wins else "zeroth" if one.zeroth_wins else "either",
            }
        )
    settings = outcome.settings
    caption = (
        f"Gradients{words.gradient.replace(',', ' in')} with half the width of their {settings.confidence:.0%} intervals, from "
        f"{settings.num_samples} rollouts each; † marks means of first order that surely have the wrong sign. A bias in bold "
        "differs from zero beyond chance over the whole table. The ratio is the variance of a sample of first order over that of "
        "zeroth order. The last column is the estimate with the clearly smaller expected error at "
        f"{settings.rollouts_per_gradient} rollouts per gradient."
    )
    return [tabulated(rows, caption)]


def _with_half_width(one: xr.Dataset, name: str) -> str:
    value, half = float(one[name]), float(one[f"{name}_high"] - one[f"{name}_low"]) / 2
    # Half a per cent is what three digits round by, and beyond them nobody reads on; the rest is in metrics.csv.
    return quantity(value) if half < 5e-3 * abs(value) else quantity(value, half)


def _choice(swept: xr.Dataset, words: Words) -> str:
    """Say up to which stiffness zeroth order is nowhere closer, by angle, and what comes beyond."""
    zeroth, last = swept.zeroth_wins.values, swept.stiffness.size
    until = np.where(zeroth.any(axis=0), zeroth.argmax(axis=0), last)
    beyond = np.arange(last)[:, None] >= until
    if (until == last).all():
        return f"first order is as close or closer at every {words.knob} and {words.place}"
    if (until == 0).all() and zeroth.all():
        return f"zeroth order is closer at every {words.knob} and {words.place}"
    parts = []
    for end in np.unique(until)[::-1]:
        limit = f"up to {words.lead}{power(swept.stiffness.values[end - 1])}{words.per}"
        where = "nowhere" if end == 0 else "everywhere" if end == last else limit
        angles = joined(f"{angle:g}" for angle in swept.angle.values[until == end])
        parts.append(f"{where} at {angles}{words.at}")
    count = f"{int((zeroth & beyond).sum())} of {int(beyond.sum())}"
    return f"first order is as close or closer {joined(parts)}, and beyond that zeroth order is closer in {count} cases"


def _default(outcome: Outcome) -> list[str]:
    default = outcome.table.isel(stiffness=outcome.table.is_default.values)
    if not default.stiffness.size:
        return []
    biased, wrong, count = int(default.is_biased.sum()), int(default.has_wrong_sign.sum()), default.angle.size
    if not biased:
        return [f"Under {_own(outcome)} no bias of first order is seen at any of the {count} {_words(outcome).place}s."]
    sign = f", and has the wrong sign at {wrong}" if wrong else ""
    return [f"Under {_own(outcome)} first order is biased at {biased} of {count} {_words(outcome).place}s{sign}."]


def _own(outcome: Outcome) -> str:
    return "the file's own contact" if outcome.settings.problem == "own" else "MuJoCo's default contact"


def drawings(outcome: Outcome) -> Drawings:
    """Draw the figures in order of reading."""
    every = {"landscape": landscape, "gradient": gradient, "bias_variance": bias_variance, "choice": choice}
    return {name: every[name](outcome) for name in _words(outcome).drawings}


def landscape(outcome: Outcome):
    """Cost against angle for each stiffness, without noise and under it."""
    figure, axes = subplots(1, 2, height=4.0, sharey=True)
    found, table = outcome.landscape, outcome.table
    assert found is not None
    colours = iter(theme.shades(int((~table.is_default).sum())))
    looks = [
        {"color": theme.DEFAULT, "ls": (0, (4, 1.5)), "label": "default"}
        if is_default
        else {"color": next(colours), "label": power(stiffness)}
        for stiffness, is_default in zip(table.stiffness.values, table.is_default.values, strict=True)
    ]
    words = _words(outcome)
    titles = ("Without noise", f"Mean under noise of {outcome.settings.stddev:g}{words.at}")
    for axis, costs, title in zip(axes[0], (found.cost, found.smoothed), titles, strict=True):
        for cost, look in zip(costs, looks, strict=True):
            axis.plot(costs[costs.dims[1]], cost, lw=1.3, **look)
        for angle in table.angle.values:
            axis.axvline(angle, color=MUTED, lw=0.8, ls=(0, (2, 3)), zorder=0)
        axis.set(title=title, xlabel=_titled(words.place, words.at), xlim=found.smooth_grid.values[[0, -1]])
    # The landscape goes on to both sides, where costs that nobody sees would set the scale.
    seen = found.cost.sel(grid=slice(*found.smooth_grid.values[[0, -1]]))
    low, high = float(seen.min()), float(seen.max())
    axes[0, 0].set_ylim(low - 0.04 * (high - low), high + 0.06 * (high - low))
    axes[0, 0].set_ylabel(words.cost)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", title=_titled(words.knob, words.per))
    caption = (
        f"Left, the cost by {words.place}: {words.shown}. Right, what noise makes of it, and what both estimates are to "
        "differentiate. Dotted lines mark the places where gradients are estimated."
    )
    return figure, f"The cost against the {words.place}", caption


def gradient(outcome: Outcome):
    """Means of both estimates and the reference against stiffness, one panel per angle."""
    figure, axes = _panels(outcome, rows=1, height=3.6)
    for j, axis in enumerate(axes[0]):
        axis.axhline(0, color=MUTED, lw=0.8)
        one = outcome.table.isel(angle=j)
        _bars(axis, one, "reference", REFERENCE, "_", "reference")
        _bars(axis, one, "zeroth_order", ZEROTH, "s", "zeroth order", shift=1.06)
        _bars(axis, one, "alpha_order", ONSET, "D", "α-order", shift=1 / 1.12)
        _bars(axis, one, "first_order", FIRST, "o", "first order", shift=1 / 1.06)
        # One wild interval of a stiff contact is not to flatten all others.
        seen = ("reference_low", "reference_high", "zeroth_order_low", "zeroth_order_high", "first_order")
        ends = np.append(one[list(seen)].to_array(), 0.0)
        margin = 0.15 * (np.nanmax(ends) - np.nanmin(ends) or 1.0)
        axis.set_ylim(np.nanmin(ends) - margin, np.nanmax(ends) + margin)
        axis.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4), useMathText=True)
    axes[0, 0].set_ylabel(f"gradient{_words(outcome).gradient}")
    theme.legend_below(figure, axes[0, 0], 4)
    caption = (
        f"Mean of {outcome.settings.num_samples} samples with its {outcome.settings.confidence:.0%} interval, at each place. "
        f"The reference comes from {outcome.settings.reference_samples} rollouts of its own. Intervals that leave a panel are "
        f"cut.{_diamond(outcome)}"
    )
    return figure, "Both estimates against the truth", caption


def bias_variance(outcome: Outcome):
    """Bias of the first-order estimate above, variance of both below, one column per angle."""
    figure, axes = _panels(outcome, rows=2, height=5.7)
    table = outcome.table
    threshold = max(float((table.bias_high - table.bias_low).median()) / 2, 1e-12)
    extreme = float(abs(table[["bias_low", "bias_high"]].to_array()).max())
    for j, (above, below) in enumerate(axes.T):
        one = table.isel(angle=j)
        above.axhline(0, color=MUTED, lw=0.8)
        _bars(above, one, "alpha_order_bias", ONSET, "D", "bias of α-order", shift=1 / 1.06)
        _bars(above, one, "bias", FIRST, "o", "bias of first order")
        chance = one.isel(stiffness=~one.is_biased.values)
        above.plot(chance.stiffness, chance.bias, "o", ms=5, mfc="white", mec=FIRST, zorder=3)
        if extreme > 10 * threshold:
            above.set_yscale("symlog", linthresh=threshold)
            above.set_ylim(-2 * extreme, 2 * extreme)
            # Labels nearer to zero would cover its own.
            above.yaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=10 * threshold))
        _bars(below, one, "zeroth_order_variance", ZEROTH, "s", "zeroth order")
        _bars(below, one, "first_order_variance", FIRST, "o", "first order")
        _bars(below, one, "alpha_order_variance", ONSET, "D", "α-order", shift=1 / 1.06)
        below.set_yscale("log")
    words = _words(outcome)
    axes[0, 0].set_ylabel(f"bias{words.gradient}")
    axes[1, 0].set_ylabel(f"variance of one sample{words.variance}")
    theme.legend_below(figure, axes[1, 0], 3)
    percent = f"{outcome.settings.confidence:.0%}"
    caption = (
        f"Above, the mean of first order and of α-order less the reference, with the {percent} interval of that; hollow "
        "where that of first order does not differ from zero beyond chance over all cases. Below, the variance of one sample "
        f"(of α-order, of estimates from 16, per rollout), with {percent} bootstrap intervals.{_diamond(outcome)}"
    )
    return figure, "Bias and variance", caption


def choice(outcome: Outcome):
    """Ratio of expected errors within the budget, for each stiffness and angle."""
    table, budget = outcome.table, outcome.settings.rollouts_per_gradient
    figure, axis = theme.panel(0.55 * table.angle.size + 1.6)
    ratio = np.log10(table.first_order_error / table.zeroth_order_error).values.T
    bound = max(0.3, np.nanmax(np.abs(ratio)))
    colours = LinearSegmentedColormap.from_list("choice", [FIRST, "#f7f7f5", ZEROTH])
    # One tone per winner: where first order wins its own colour shows.
    axis.imshow(ratio, cmap=colours, vmin=-bound, vmax=bound, aspect="auto")
    for j, i in np.ndindex(ratio.shape):
        one = table.isel(stiffness=i, angle=j)
        text = f"{10 ** ratio[j, i]:.2g}" + ("*" if one.is_biased else "") + ("†" if one.has_wrong_sign else "")
        colour = "white" if abs(ratio[j, i]) > 0.6 * bound else REFERENCE
        axis.text(i, j, text, ha="center", va="center", fontsize=9, color=colour)
    count = outcome.swept.stiffness.size
    names = [power(stiffness) for stiffness in outcome.swept.stiffness.values]
    if count < table.stiffness.size:
        names.append("default")
        axis.axvline(count - 0.5, color="white", lw=6)
    axis.set_xticks(range(len(names)), names)
    axis.set_yticks(range(table.angle.size), [f"{angle:g}" for angle in table.angle.values])
    words = _words(outcome)
    axis.set(xlabel=_titled(words.knob, words.per), ylabel=_titled(words.place, words.at))
    axis.set_title(f"Expected error with {budget} rollouts: first order over zeroth order")
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    caption = (
        f"Root of squared bias plus variance over {budget}, of first order divided by that of zeroth order: orange, and below "
        "1, where first order is closer to the truth, blue where zeroth order is. A bias counts where it is beyond chance (*); "
        "† marks the wrong sign."
    )
    return figure, "Which estimate is closer", caption


def video(outcome: Outcome, workspace: Workspace, wanted: ThrowsSettings) -> tuple[str | None, str]:
    """Draw the throws that the settings ask for, and give the file and its caption; nothing if there are none."""
    task = outcome.task
    if task is None:
        return None, ""
    knob = wall_contact(task, np.asarray(wanted.stiffness), outcome.settings.damping_ratio, with_default=False)
    mj_model = with_coarse_shadows(task.scene.mj_model)

    @jax.jit
    def throw(softness, angles):
        thrown = task.with_softness(softness)
        return jax.vmap(lambda angle: mg.rollout(thrown.scene, thrown.start(angle[None]), horizon=thrown.horizon).qpos)(
            angles
        )

    motions = [
        (mj_model, qpos)
        for i in range(len(wanted.stiffness))
        for qpos in throw(jax.tree.map(lambda leaf, i=i: leaf[i], knob), jnp.asarray(wanted.angles))
    ]
    titles = [f"{angle:g} rad, stiffness {power(k)} 1/s²" for k in wanted.stiffness for angle in wanted.angles]
    caption = f"Throws without noise, by angle (columns) and stiffness of the wall (rows), {shown_speed(wanted.speed)}."
    return film(workspace, motions, wanted, camera="side", caption=caption, titles=titles, columns=len(wanted.angles))


def _diamond(outcome: Outcome) -> str:
    has_default = outcome.table.is_default.any()
    return f" The diamond on the dashed line is {_own(outcome)}." if has_default else ""


def _panels(outcome: Outcome, *, rows: int, height: float):
    table, words = outcome.table, _words(outcome)
    figure, axes = subplots(rows, table.angle.size, height=height, sharex=True, sharey="row" if rows > 1 else False)
    first, last = np.log10(outcome.swept.stiffness.values[[0, -1]])
    ticks = 10.0 ** np.arange(np.ceil(first - 1e-9), last + 1e-9, 1 if last - first <= 3 else 2)
    for axis in axes.flat:
        axis.set_xscale("log")
        axis.set_xticks(ticks, [power(tick) for tick in ticks])
        axis.xaxis.set_minor_locator(NullLocator())
        for stiffness in table.stiffness.values[table.is_default.values]:
            axis.axvline(stiffness, color=MUTED, lw=1.0, ls=(0, (4, 3)), zorder=0)
    for top, bottom, angle in zip(axes[0], axes[-1], table.angle.values, strict=True):
        top.set_title(f"{angle:g}{words.at}" if words.at else f"{words.place} {angle:g}")
        bottom.set_xlabel(_titled(words.knob, words.per))
    return figure, axes


def _bars(axis: Axes, one: xr.Dataset, name: str, colour: str, marker: str, label: str, shift: float = 1.0) -> None:
    """Draw an interval against stiffness: the sweep as a line, the default as a point beside it."""
    if name not in one:  # α-order of too few samples
        return
    swept = ~one.is_default.values
    for rows, look in ((swept, {"marker": marker, "lw": 1.2, "label": label}), (~swept, {"marker": "D", "ls": ""})):
        picked = one.isel(stiffness=rows)
        ends = picked[[f"{name}_low", f"{name}_high"]].to_array().values
        theme.errorbar(axis, shift * picked.stiffness.values, picked[name].values, ends, color=colour, ms=5, **look)
