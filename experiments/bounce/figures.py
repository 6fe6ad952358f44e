"""The pictures of an experiment on bounces."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm

from experiments.bounce.measure import TOLERANCE, Outcome
from experiments.motion import CONTINUOUS, DISCRETE, EVENT
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, plain, subplots

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
