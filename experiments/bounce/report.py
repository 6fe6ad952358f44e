"""The answer of an experiment on bounces in words, computed from its numbers."""

import itertools

import numpy as np

from experiments.bounce.measure import CONTACT, Outcome
from experiments.motion import CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
from experiments.words import joined

# Steps in contact by which the outcome is told apart.
_STEPS = (0, 3, 6, 10, 20, np.inf)
_ORDER = (CONTINUOUS, EVENT, DISCRETE)


def verdict(outcome: Outcome) -> str:
    """Say how often each derivative is the slope."""
    settings = outcome.settings
    fine = outcome.grid.where(outcome.grid.timestep <= settings.fine_timestep, drop=True)
    judged = int(fine.judged.sum())
    if not judged:
        return "At no contact is the slope known well enough: take more phases."
    within = [f"{int(fine.holds.sel(arm=arm).sum())} ({arm})" for arm in _ORDER]
    sentence = (
        f"Up to {1e3 * settings.fine_timestep:g} ms the mean derivative is within {settings.tolerance:.0%} of the slope at "
        f"{joined(within)} of {judged} contacts and time steps."
    )
    coarse = outcome.grid.isel(timestep=np.isclose(outcome.grid.timestep, settings.coarse_timestep))
    if not coarse.timestep.size:
        return sentence
    close = [int(((coarse.error <= settings.coarse_tolerance) & coarse.judged).sel(arm=arm).sum()) for arm in _ORDER]
    return (
        f"{sentence} At {1e3 * settings.coarse_timestep:g} ms it is within {settings.coarse_tolerance:.0%} at {close[0]} and "
        f"{close[1]} (event) of {int(coarse.judged.sum())}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what no table shows: the discrete gradient by how contact sets in, differences, and how well the truth is known."""
    grid, sentences = outcome.grid, []
    ratio = abs(grid["mean"].sel(arm=DISCRETE) / grid.slope.sel(arm=DISCRETE))
    jumps = ratio.where(grid.judged & (grid.impedance_first > 0))
    if jumps.notnull().any():
        sentences.append(
            f"Where contact sets in with a jump of force the discrete gradient is {float(jumps.median()):.3g} times the slope "
            f"in the median and up to {float(jumps.max()):.3g} times."
        )
    change = abs(grid["mean"].sel(arm=EVENT) - grid["mean"].sel(arm=DISCRETE)) / abs(grid.slope.sel(arm=DISCRETE))
    gentle = change.where(grid.judged & (grid.impedance_first == 0))
    if gentle.notnull().any():
        sentences.append(
            "Where contact sets in gently there is nothing to correct, and both gradients differ by "
            f"{float(gentle.median()):.1%} of the slope in the median and {float(gentle.max()):.1%} at most."
        )
    wide = abs(grid.wide / grid.slope.sel(arm=DISCRETE) - 1).where(grid.judged)
    sentences.append(
        f"Finite differences over one step's flight, two rollouts per parameter, are off by {float(wide.median()):.1%} of the "
        f"slope in the median and {float(wide.max()):.0%} at most; far shorter ones give the discrete gradient."
    )
    if grid.closed_form.notnull().any():
        finest = grid.isel(timestep=0)
        off = abs(finest.slope / grid.truth - 1).where(finest.judged).max(CONTACT)
        sentences.append(
            f"Quadrature and closed form agree to {float(abs(grid.truth - grid.closed_form).max()):.0e} where there is one. At "
            f"{1e3 * float(finest.timestep):g} ms the slope of the simulated height is within "
            f"{float(off.sel(arm=DISCRETE)):.1%} of the truth, with an onset within {float(off.sel(arm=CONTINUOUS)):.1%}."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate where the derivatives hold: by how many steps the contact lasts, and contact by contact."""
    return [_by_steps(outcome), _by_contact(outcome)]


def _by_steps(outcome: Outcome) -> Table:
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
    heads = [
        f"{what}, {arm}" for arm in _ORDER for what in (f"within {outcome.settings.tolerance:.0%}", "error", "spread")
    ]
    return Table(
        ("steps in contact", "judged", *heads),
        rows,
        "Contacts and time steps by how long the contact lasts. Error of the mean derivative as a share of the slope of its own "
        "height, at most 100%, and standard deviation of single derivatives over the slope: medians.",
    )


def _by_contact(outcome: Outcome) -> Table:
    grid, rows, emphasised = outcome.grid.sel(arm=CONTINUOUS), [], set()
    for place in np.ndindex(grid.truth.shape):
        one = grid.isel(dict(zip(CONTACT, place, strict=True)))
        emphasised |= {(len(rows), 4 + int(i)) for i in np.flatnonzero(one.fails)}
        errors = zip(one.error.values, one.judged.values, strict=True)
        rows.append(
            [
                f"{float(one.damping_ratio):g}",
                f"{1e3 * float(one.time_constant):g}",
                str(one.impedance.values),
                f"{float(one.truth):.3f}".replace("-", "−"),
                *(f"{error:.1%}" if judged else "—" for error, judged in errors),
            ]
        )
    heads = [f"{1e3 * h:g} ms" for h in grid.timestep.values]
    return Table(
        ("damping ratio", "time constant, ms", "impedance", "truth", *heads),
        rows,
        "Error with contact that begins within the step, contact by contact, by time step. Bold where it is beyond the "
        "tolerance by more than two standard errors; — where the step is unstable or the slope not known well enough.",
        frozenset(emphasised),
    )
