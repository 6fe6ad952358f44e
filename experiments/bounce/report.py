"""The answer of an experiment on bounces in words, computed from its numbers."""

import itertools

import numpy as np

from experiments.bounce.measure import CONTACT, TOLERANCE, Outcome
from experiments.motion import CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
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
