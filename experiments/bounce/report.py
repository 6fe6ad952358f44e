"""The answer of an experiment on bounces in words, computed from its numbers."""

import itertools

import numpy as np

from experiments.bounce.outcome import Outcome
from experiments.motion import CONTINUOUS, DISCRETE, EVENT
from experiments.report import Table
from experiments.words import joined

# Steps in contact by which the outcome is told apart.
_STEPS = (0, 3, 6, 10, 20, np.inf)


def verdict(outcome: Outcome) -> str:
    """Say how often each derivative is the slope."""
    settings = outcome.settings
    fine = outcome.timesteps <= settings.fine_timestep
    judged = outcome.can_judge[fine]
    if not judged.any():
        return "At no contact is the slope known well enough: take more phases."
    within = [f"{outcome.holds(arm)[fine].sum()} ({arm})" for arm in (CONTINUOUS, EVENT, DISCRETE)]
    sentences = [
        f"Up to {1e3 * settings.fine_timestep:g} ms the mean derivative is within {settings.tolerance:.0%} of the slope at "
        f"{joined(within)} of {judged.sum()} contacts and time steps."
    ]
    if (coarse := _coarse(outcome)) is not None:
        sentences.append(coarse)
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    return [
        sentence
        for sentence in (_jump(outcome), _gentle(outcome), _wide(outcome), _closed_form(outcome))
        if sentence is not None
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate where the derivatives hold: by how many steps the contact lasts, and contact by contact."""
    return [_by_steps(outcome), _by_contact(outcome)]


def _coarse(outcome: Outcome) -> str | None:
    settings = outcome.settings
    at = np.flatnonzero(np.isclose(outcome.timesteps, settings.coarse_timestep))
    if not at.size:
        return None
    judged = outcome.can_judge[at[0]]
    close = [(outcome.error(arm)[at[0]] <= settings.coarse_tolerance) & judged for arm in (CONTINUOUS, EVENT)]
    return (
        f"At {1e3 * settings.coarse_timestep:g} ms it is within {settings.coarse_tolerance:.0%} at {close[0].sum()} and "
        f"{close[1].sum()} (event) of {judged.sum()}."
    )


def _jump(outcome: Outcome) -> str | None:
    has_jump = np.array([cell.impedance.first > 0 for cell in outcome.cells])
    ratio = np.abs(outcome.mean(DISCRETE) / outcome.slope())[outcome.can_judge & has_jump]
    if not ratio.size:
        return None
    return (
        f"Where contact sets in with a jump of force the discrete gradient is {np.median(ratio):.3g} times the slope in the "
        f"median and up to {ratio.max():.3g} times."
    )


def _gentle(outcome: Outcome) -> str | None:
    gentle = outcome.can_judge & np.array([cell.impedance.first == 0 for cell in outcome.cells])
    if not gentle.any():
        return None
    change = np.abs(outcome.mean(EVENT) - outcome.mean(DISCRETE))[gentle] / np.abs(outcome.slope())[gentle]
    return (
        f"Where contact sets in gently there is nothing to correct, and both gradients differ by {np.median(change):.1%} of the "
        f"slope in the median and {change.max():.1%} at most."
    )


def _wide(outcome: Outcome) -> str:
    slope = outcome.slope()[outcome.can_judge]
    error = np.abs(outcome.wide[outcome.can_judge] - slope) / np.abs(slope)
    return (
        f"Finite differences over one step's flight, two rollouts per parameter, are off by {np.median(error):.1%} of the slope "
        f"in the median and {error.max():.0%} at most; far shorter ones give the discrete gradient."
    )


def _closed_form(outcome: Outcome) -> str | None:
    closed = np.array([cell.closed_form for cell in outcome.cells])
    has_closed = np.isfinite(closed)
    if not has_closed.any():
        return None
    truth = np.array([cell.truth for cell in outcome.cells])
    apart = np.abs(truth - closed)[has_closed].max()
    finest = outcome.can_judge[0]
    off = [np.abs(outcome.slope(arm)[0] - truth)[finest] / np.abs(truth)[finest] for arm in (DISCRETE, CONTINUOUS)]
    return (
        f"Quadrature and closed form agree to {apart:.0e} where there is one. At {1e3 * outcome.timesteps[0]:g} ms the slope of "
        f"the simulated height is within {off[0].max():.1%} of the truth, with an onset within {off[1].max():.1%}."
    )


def _by_steps(outcome: Outcome) -> Table:
    count, rows = outcome.steps_in_contact, []
    for low, high in itertools.pairwise(_STEPS):
        inside = outcome.can_judge & (count >= low) & (count < high)
        if not inside.any():
            continue
        name = f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} and more"
        row = [name, f"{inside.sum()}"]
        for arm in (CONTINUOUS, EVENT, DISCRETE):
            errors = outcome.error(arm)[inside]
            spread = (outcome.spread(arm) / np.abs(outcome.slope(arm)))[inside]
            row += [f"{outcome.holds(arm)[inside].sum()}", f"{np.median(errors):.1%}", f"{np.median(spread):.2g}"]
        rows.append(row)
    percent = f"{outcome.settings.tolerance:.0%}"
    heads = [
        f"{what}, {arm}" for arm in (CONTINUOUS, EVENT, DISCRETE) for what in (f"within {percent}", "error", "spread")
    ]
    return Table(
        ("steps in contact", "judged", *heads),
        rows,
        "Contacts and time steps by how long the contact lasts. Error of the mean derivative as a share of the slope of its own "
        "height, at most 100%, and standard deviation of single derivatives over the slope: medians.",
    )


def _by_contact(outcome: Outcome) -> Table:
    errors, fails, rows, emphasised = outcome.error(CONTINUOUS), outcome.fails(CONTINUOUS), [], set()
    for j, cell in enumerate(outcome.cells):
        for i in np.flatnonzero(fails[:, j]):
            emphasised.add((j, 4 + int(i)))
        rows.append(
            [
                f"{cell.damping_ratio:g}",
                f"{1e3 * cell.time_constant:g}",
                cell.impedance.label,
                f"{cell.truth:.3f}".replace("-", "−"),
                *(f"{errors[i, j]:.1%}" if outcome.can_judge[i, j] else "—" for i in range(len(outcome.timesteps))),
            ]
        )
    heads = [f"{1e3 * h:g} ms" for h in outcome.timesteps]
    return Table(
        ("damping ratio", "time constant, ms", "impedance", "truth", *heads),
        rows,
        "Error with contact that begins within the step, contact by contact, by time step. Bold where it is beyond the "
        "tolerance by more than two standard errors; — where the step is unstable or the slope not known well enough.",
        frozenset(emphasised),
    )
