"""The answer of an experiment on bounces: words, tables, pictures."""

import itertools

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm

from experiments.bounce.measure import CONTACT, TOLERANCE, Outcome
from experiments.motion import CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.words import joined

# Steps in contact by which the outcome is told apart.
_STEPS = (0, 3, 6, 10, 20, np.inf)
# Largest time step at which the tolerance is asked for, and one at which this one is enough (s).
_FINE, _COARSE, _COARSE_TOLERANCE = 5e-4, 2e-3, 0.3
_ORDER = (CONTINUOUS, EVENT, DISCRETE)


def verdict(outcome: Outcome) -> str:
    """Say how often each derivative is the slope."""
    grid = outcome.grid
    fine = grid.isel(timestep=grid.timestep.values <= _FINE)
    coarse = grid.isel(timestep=np.isclose(grid.timestep.values, _COARSE))
    judged = int(fine.judged.sum())
    if not judged:
        return "At no contact is the slope known well enough: take more phases."
    within = [f"{int(fine.holds.sel(arm=arm).sum())} ({arm})" for arm in _ORDER]
    sentence = (
        f"Up to {1e3 * _FINE:g} ms the mean derivative is within {TOLERANCE:.0%} of the slope at {joined(within)} of {judged} "
        "contacts and time steps."
    )
    if not coarse.timestep.size:
        return sentence
    close = [int(((coarse.error <= _COARSE_TOLERANCE) & coarse.judged).sel(arm=arm).sum()) for arm in _ORDER]
    return (
        f"{sentence} At {1e3 * _COARSE:g} ms it is within {_COARSE_TOLERANCE:.0%} at {close[0]} and {close[1]} (event) of "
        f"{int(coarse.judged.sum())}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what no table shows: the discrete gradient by how contact sets in, differences, and how well the truth is known."""
    grid, sentences = outcome.grid, []
    if not grid.judged.any():
        return []
    slope, discrete = abs(grid.slope.sel(arm=DISCRETE)), grid["mean"].sel(arm=DISCRETE)
    jumps = (abs(discrete) / slope).where(grid.judged & (grid.impedance_first > 0))
    if jumps.notnull().any():
        sentences.append(
            f"Where contact sets in with a jump of force the discrete gradient is {float(jumps.median()):.3g} times the slope "
            f"in the median and up to {float(jumps.max()):.3g} times."
        )
    gentle = (abs(grid["mean"].sel(arm=EVENT) - discrete) / slope).where(grid.judged & (grid.impedance_first == 0))
    if gentle.notnull().any():
        sentences.append(
            "Where contact sets in gently there is nothing to correct, and both gradients differ by "
            f"{float(gentle.median()):.1%} of the slope in the median and {float(gentle.max()):.1%} at most."
        )
    wide = (abs(grid.wide - grid.slope.sel(arm=DISCRETE)) / slope).where(grid.judged)
    sentences.append(
        f"Finite differences over one step's flight, two rollouts per parameter, are off by {float(wide.median()):.1%} of the "
        f"slope in the median and {float(wide.max()):.0%} at most."
    )
    if grid.closed_form.notnull().any():
        finest = grid.isel(timestep=0)
        off = (abs(finest.slope - grid.truth) / abs(grid.truth)).where(finest.judged).max(CONTACT)
        sentences.append(
            f"Quadrature and closed form agree to {float(abs(grid.truth - grid.closed_form).max()):.0e} where there is one. At "
            f"{1e3 * float(finest.timestep):g} ms the slope of the simulated height is within "
            f"{float(off.sel(arm=DISCRETE)):.1%} of the truth, with an onset within {float(off.sel(arm=CONTINUOUS)):.1%}."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate where the derivatives hold by how many steps the contact lasts."""
    grid, rows = outcome.grid, []
    spread = grid.spread / abs(grid.slope)
    for low, high in itertools.pairwise(_STEPS):
        inside = grid.judged & (grid.steps_in_contact >= low) & (grid.steps_in_contact < high)
        if not inside.any():
            continue
        row = [f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} and more", str(int(inside.sum()))]
        for arm in _ORDER:
            error, width = (float(one.sel(arm=arm).where(inside).median()) for one in (grid.error, spread))
            row += [str(int(grid.holds.sel(arm=arm).where(inside, False).sum())), f"{error:.1%}", f"{width:.2g}"]
        rows.append(row)
    heads = [f"{what}, {arm}" for arm in _ORDER for what in (f"within {TOLERANCE:.0%}", "error", "spread")]
    caption = (
        "Contacts and time steps by how long the contact lasts. Error of the mean derivative as a share of the slope of its own "
        "height, at most 100%, and standard deviation of single derivatives over the slope: medians."
    )
    return [Table(("steps in contact", "judged", *heads), rows, caption)]


_LOOKS = {DISCRETE: (FIRST, "o"), EVENT: (ZEROTH, "s"), CONTINUOUS: (ONSET, "D")}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"derivative": derivative, "error": error}


def derivative(outcome: Outcome):
    """Means and spreads of all derivatives against the time step, for each damping ratio at one contact."""
    settings, grid = outcome.settings, outcome.grid
    # MuJoCo's own time constant and impedance, or what comes nearest.
    at = {
        "time_constant": int(np.argmin(abs(grid.time_constant.values - 0.02))),
        "impedance": int(np.argmin((abs(grid.impedance_first - 0.9) + abs(grid.impedance_last - 0.95)).values)),
    }
    shown = grid.isel(at).isel(damping_ratio=slice(None, None, -(-len(settings.damping_ratios) // 5)))
    figure, axes = subplots(1, shown.damping_ratio.size, height=3.6, sharey=True)
    h = 1e3 * shown.timestep.values
    for axis, ratio in zip(axes[0], shown.damping_ratio.values, strict=True):
        one = shown.sel(damping_ratio=ratio)
        axis.axhline(one.truth, color=REFERENCE, lw=1, ls=(0, (2, 2)), label="truth")
        axis.plot(h, one.slope.sel(arm=DISCRETE), color=REFERENCE, lw=2.6, label="slope of the simulated height")
        means = {arm: (one["mean"].sel(arm=arm), one.spread.sel(arm=arm), *look) for arm, look in _LOOKS.items()}
        means["difference over one step's flight"] = one.wide, one.wide_spread, MUTED, "^"
        for shift, (label, (mean, spread, colour, marker)) in zip((0.94, 0.98, 1.02, 1.06), means.items(), strict=True):
            axis.errorbar(
                h * shift, mean, spread, color=colour, marker=marker, ms=4, lw=1, elinewidth=1, capsize=2, label=label
            )
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=0.1)
        axis.set(title=f"damping ratio {ratio:g}", xlabel="time step, ms")
        plain(axis.xaxis)
        plain(axis.yaxis)
    axes[0, 0].set_ylabel("derivative")
    name = f"Time constant {1e3 * float(shown.time_constant):g} ms, impedance {shown.impedance.values}"
    figure.suptitle(name, fontsize=10)
    legend_below(figure, axes[0, 0], 3)
    caption = (
        f"Derivative of the height after {settings.duration:g} s with respect to the start height, mean over "
        f"{settings.num_phases} start heights; bars are the standard deviation over them, the phases of the time step. The "
        "truth is less the restitution, by quadrature of the contact's own equation. Finite differences span what the ball "
        "flies in one step. The axis is linear between −0.1 and 0.1."
    )
    return figure, "Derivative against time step", caption


def error(outcome: Outcome):
    """A map per impedance and time step: damping ratio across, time constant up."""
    settings, grid = outcome.settings, outcome.grid.sel(arm=CONTINUOUS)
    rows, columns = grid.impedance.size, grid.timestep.size
    figure, axes = subplots(rows, columns, height=0.9 + 1.35 * rows, sharex=True, sharey=True)
    look = ScalarMappable(LogNorm(1e-3, 1), "RdYlBu_r")
    for i, j in np.ndindex(rows, columns):
        axis, one = axes[i, j], grid.isel(impedance=i, timestep=j).transpose("time_constant", "damping_ratio")
        axis.imshow(one.error.clip(1e-3, 1), norm=look.norm, cmap=look.cmap, origin="lower", aspect="auto")
        for where, marker, size in ((~one.judged, "x", 6), (one.judged & ~one.holds & ~one.fails, ".", 4)):
            up, across = np.nonzero(where.values)
            axis.plot(across, up, marker, color=REFERENCE, ms=size)
        axis.grid(visible=False)
        axis.set_xticks(range(grid.damping_ratio.size), [f"{value:g}" for value in settings.damping_ratios])
        axis.set_yticks(range(grid.time_constant.size), [f"{1e3 * value:g}" for value in settings.time_constants])
        if i == 0:
            axis.set_title(f"{1e3 * settings.timesteps[j]:g} ms")
        if i == rows - 1:
            axis.set_xlabel("damping ratio")
        if j == 0:
            axis.set_ylabel(f"{settings.impedances[i].label}\ntime constant, ms", fontsize=8)
    bar = figure.colorbar(look, ax=axes, shrink=0.8, pad=0.01)
    names = {1e-3: "≤ 0.1%", 1e-2: "1%", TOLERANCE: f"{TOLERANCE:.0%}", 0.3: "30%", 1: "≥ 100%"}
    bar.set_ticks(list(names), labels=list(names.values()))
    bar.ax.minorticks_off()
    caption = (
        "Error of the derivative with contact that begins within the step, as a share of the slope, one square per contact. A "
        "dot: beyond the tolerance, but not beyond two standard errors of the means. Crossed squares are not judged: the step "
        "is unstable there, or the slope is not known well enough."
    )
    return figure, "Error over all contacts", caption
