"""The pictures of an experiment on bounces."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.ticker import FuncFormatter

from experiments.bounce.outcome import Outcome
from experiments.motion import CONTINUOUS, DISCRETE, EVENT
from experiments.theme import FIRST, MUTED, REFERENCE, ZEROTH, Drawings, subplots

_CONTINUOUS = "#009e73"
_LOOKS = ((DISCRETE, FIRST, "o"), (EVENT, ZEROTH, "s"), (CONTINUOUS, _CONTINUOUS, "D"))


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"derivative": derivative, "steps": steps, "error": error}


def derivative(outcome: Outcome):
    """Means and spreads of all derivatives against the time step, for each damping ratio at one contact."""
    settings = outcome.settings
    # MuJoCo's own time constant and impedance, or what comes nearest.
    constant = min(settings.time_constants, key=lambda value: abs(value - 0.02))
    impedance = min(settings.impedances, key=lambda one: abs(one.first - 0.9) + abs(one.last - 0.95))
    shown = [
        j for j, cell in enumerate(outcome.cells) if cell.time_constant == constant and cell.impedance == impedance
    ]
    shown = shown[:: -(-len(shown) // 5)]
    figure, axes = subplots(1, len(shown), height=3.6, sharey=True)
    h = 1e3 * outcome.timesteps
    for axis, j in zip(axes[0], shown, strict=True):
        axis.axhline(outcome.cells[j].truth, color=REFERENCE, lw=1, ls=(0, (2, 2)), label="truth")
        axis.plot(h, outcome.slope()[:, j], color=REFERENCE, lw=2.6, label="slope of the simulated height")
        looks = (
            (outcome.mean(DISCRETE), outcome.spread(DISCRETE), FIRST, "o", "discrete gradient", 0.94),
            (outcome.mean(EVENT), outcome.spread(EVENT), ZEROTH, "s", "event gradient", 0.98),
            (outcome.mean(CONTINUOUS), outcome.spread(CONTINUOUS), _CONTINUOUS, "D", "continuous onset", 1.02),
            (outcome.wide, outcome.wide_spread, MUTED, "^", "difference over one step's flight", 1.06),
        )
        for mean, spread, colour, marker, label, shift in looks:
            axis.errorbar(
                h * shift, mean[:, j], spread[:, j], color=colour, marker=marker, ms=4, lw=1, elinewidth=1, capsize=2,
                label=label,
            )  # fmt: skip
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=0.1)
        axis.set(title=f"damping ratio {outcome.cells[j].damping_ratio:g}", xlabel="time step, ms")
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))
    axes[0, 0].set_ylabel("derivative")
    figure.suptitle(f"Time constant {1e3 * constant:g} ms, impedance {impedance.label}", fontsize=10)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8.5)
    caption = (
        f"Derivative of the height after {settings.duration:g} s with respect to the start height, mean over "
        f"{settings.num_phases} start heights; bars are the standard deviation over them, the phases of the time step. The "
        "truth is less the restitution, by quadrature of the contact's own equation. Finite differences span what the ball "
        "flies in one step; far shorter ones give the discrete gradient. The axis is linear between −0.1 and 0.1."
    )
    return figure, "Derivative against time step", caption


def error(outcome: Outcome):
    """A map per impedance and time step: damping ratio across, time constant up."""
    settings = outcome.settings
    rows, columns = len(settings.impedances), len(settings.timesteps)
    figure, axes = subplots(rows, columns, height=0.9 + 1.35 * rows, sharex=True, sharey=True)
    shape = (len(settings.damping_ratios), len(settings.time_constants), rows)
    errors = outcome.error(CONTINUOUS).reshape(-1, *shape)
    judged = outcome.can_judge.reshape(-1, *shape)
    unsure = outcome.can_judge & ~outcome.holds(CONTINUOUS) & ~outcome.fails(CONTINUOUS)
    unsure = unsure.reshape(-1, *shape)
    look = ScalarMappable(LogNorm(1e-3, 1), "RdYlBu_r")
    for i, j in np.ndindex(rows, columns):
        axis = axes[i, j]
        shown = np.clip(errors[j, :, :, i].T, 1e-3, 1)
        axis.imshow(shown, norm=look.norm, cmap=look.cmap, origin="lower", aspect="auto")
        for ratio, constant in np.argwhere(~judged[j, :, :, i]):
            axis.plot(ratio, constant, "x", color=REFERENCE, ms=6)
        for ratio, constant in np.argwhere(unsure[j, :, :, i]):
            axis.plot(ratio, constant, ".", color=REFERENCE, ms=4)
        axis.grid(visible=False)
        axis.set_xticks(range(shape[0]), [f"{value:g}" for value in settings.damping_ratios])
        axis.set_yticks(range(shape[1]), [f"{1e3 * value:g}" for value in settings.time_constants])
        if i == 0:
            axis.set_title(f"{1e3 * settings.timesteps[j]:g} ms")
        if i == rows - 1:
            axis.set_xlabel("damping ratio")
        if j == 0:
            axis.set_ylabel(f"{settings.impedances[i].label}\ntime constant, ms", fontsize=8)
    bar = figure.colorbar(look, ax=axes, shrink=0.8, pad=0.01)
    bar.set_ticks(
        [1e-3, 1e-2, settings.tolerance, 0.3, 1],
        labels=["≤ 0.1%", "1%", f"{settings.tolerance:.0%}", "30%", "≥ 100%"],
    )
    bar.ax.minorticks_off()
    caption = (
        "Error of the derivative with contact that begins within the step, as a share of the slope, one square per contact. A "
        "dot: beyond the tolerance, but not beyond two standard errors of the means. Crossed squares are not judged: the step "
        "is unstable there, or the slope is not known well enough."
    )
    return figure, "Error over all contacts", caption


def steps(outcome: Outcome):
    """Errors of all derivatives against how many steps a contact lasts; contacts that set in with a jump apart."""
    figure, axes = subplots(1, 2, height=3.6, sharey=True, sharex=True)
    has_jump = np.array([cell.impedance.first > 0 for cell in outcome.cells])
    titles = ("Contact sets in with a jump of force", "Contact sets in gently")
    for axis, chosen, title in zip(axes[0], (has_jump, ~has_jump), titles, strict=True):
        judged = outcome.can_judge & chosen
        for name, colour, marker in _LOOKS:
            errors = np.maximum(outcome.error(name)[judged], 1e-4)
            axis.plot(
                outcome.steps_in_contact[judged], errors, marker, color=colour, ms=3.5, mec="none", alpha=0.6,
                label=name,
            )  # fmt: skip
        axis.axhline(outcome.settings.tolerance, color=MUTED, lw=1, ls=(0, (2, 3)))
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set(title=title, xlabel="time steps that the contact lasts")
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g}%"))
    axes[0, 0].set_ylabel("error")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8.5)
    settings = outcome.settings
    caption = (
        "The same errors, of all three, against the number of time steps that the contact lasts: one dot per contact and time "
        f"step. Dotted, {settings.tolerance:.0%}. Errors larger than the slope lie at 100%, those below 10⁻⁴ there."
    )
    return figure, "Error against steps in contact", caption
