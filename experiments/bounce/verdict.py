"""The answer of an experiment on bounces in words, computed from its numbers."""

import itertools

import numpy as np

from experiments.bounce.outcome import DISCRETE, EVENT, Outcome
from experiments.report import Table

# Steps in contact by which the outcome is told apart.
_MANY_STEPS = 10
_STEPS = (0, 3, 6, 10, 20, np.inf)


def verdict(outcome: Outcome) -> str:
    """Say how often the event gradient is the restitution, and how far off the discrete one is.

    Args:
        outcome: the numbers.

    Returns:
        A few sentences.
    """
    settings = outcome.settings
    fine = outcome.timesteps <= settings.fine_timestep
    judged, holds = outcome.can_judge[fine], outcome.holds[fine]
    if not judged.any():
        return "At no contact is the slope known well enough: take more phases."
    has_jump = np.array([cell.impedance.first > 0 for cell in outcome.cells])
    ratio = np.abs(outcome.mean(DISCRETE) / outcome.slope)[outcome.can_judge & has_jump]
    sentences = [
        f"Up to {1e3 * settings.fine_timestep:g} ms the event gradient is within {settings.tolerance:.0%} at {holds.sum()} of "
        f"{judged.sum()} contacts and time steps, and farther off beyond chance at {outcome.fails[fine].sum()}."
    ]
    if (coarse := _coarse(outcome)) is not None:
        sentences.append(coarse)
    if ratio.size:
        low, high = np.quantile(ratio, [0.5, 1.0])
        sentences.append(
            f"Where contact sets in with a jump of force the discrete gradient is {low:.3g} times the slope in the median "
            f"and up to {high:.3g} times."
        )
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each.

    Args:
        outcome: the numbers.

    Returns:
        The sentences that the numbers support.
    """
    return [
        sentence
        for sentence in (_failures(outcome), _gentle(outcome), _wide(outcome), _closed_form(outcome))
        if sentence is not None
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate where the event gradient holds: by how many steps the contact lasts, and contact by contact."""
    return [_by_steps(outcome), _by_contact(outcome)]


def _coarse(outcome: Outcome) -> str | None:
    settings = outcome.settings
    at = np.flatnonzero(np.isclose(outcome.timesteps, settings.coarse_timestep))
    if not at.size:
        return None
    judged = outcome.can_judge[at[0]]
    close = (outcome.share_of_slope[at[0]] <= settings.coarse_tolerance) & judged
    return (
        f"At {1e3 * settings.coarse_timestep:g} ms it is within {settings.coarse_tolerance:.0%} of the slope at {close.sum()} of "
        f"{judged.sum()}."
    )


def _failures(outcome: Outcome) -> str | None:
    """Say what the failures have in common: few steps in contact."""
    fails, judged, is_long = outcome.fails, outcome.can_judge, outcome.steps_in_contact >= _MANY_STEPS
    if not fails.any():
        return None
    return (
        f"Beyond {outcome.settings.tolerance:.0%}, and beyond chance, it is at {(fails & ~is_long).sum()} of "
        f"{(judged & ~is_long).sum()} contacts that last fewer than {_MANY_STEPS} time steps and at {(fails & is_long).sum()} of "
        f"{(judged & is_long).sum()} that last longer."
    )


def _gentle(outcome: Outcome) -> str | None:
    gentle = outcome.can_judge & np.array([cell.impedance.first == 0 for cell in outcome.cells])
    if not gentle.any():
        return None
    change = np.abs(outcome.mean(EVENT) - outcome.mean(DISCRETE))[gentle] / np.abs(outcome.slope)[gentle]
    return (
        f"Where contact sets in gently there is nothing to correct, and both gradients differ by {np.median(change):.1%} of the "
        f"slope in the median and {change.max():.1%} at most."
    )


def _wide(outcome: Outcome) -> str:
    error = np.abs(outcome.wide - outcome.slope)[outcome.can_judge] / np.abs(outcome.slope)[outcome.can_judge]
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
    off = np.abs(outcome.slope[0] - truth)[finest] / np.abs(truth)[finest]
    return (
        f"Quadrature and closed form agree to {apart:.0e} where there is one. At {1e3 * outcome.timesteps[0]:g} ms the slope of "
        f"the simulated height is within {off.max():.1%} of the truth."
    )


def _by_steps(outcome: Outcome) -> Table:
    count, rows = outcome.steps_in_contact, []
    for low, high in itertools.pairwise(_STEPS):
        inside = outcome.can_judge & (count >= low) & (count < high)
        if not inside.any():
            continue
        errors = [outcome.error(name)[inside] for name in (EVENT, DISCRETE)]
        spread = (outcome.spread(EVENT) / np.abs(outcome.slope))[inside]
        name = f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} and more"
        rows.append(
            [
                name,
                f"{inside.sum()}",
                f"{outcome.holds[inside].sum()}",
                f"{outcome.fails[inside].sum()}",
                f"{np.median(errors[0]):.1%}, {errors[0].max():.0%}",
                f"{np.median(errors[1]):.0%}",
                f"{np.median(spread):.2g}",
            ]
        )
    percent = f"{outcome.settings.tolerance:.0%}"
    return Table(
        (
            "steps in contact", "judged", f"within {percent}", "beyond it and chance", "error of event: median, largest",
            "error of discrete: median", "spread of event over slope",
        ),
        rows,
        "Contacts and time steps by how long the contact lasts. Errors as a share of the larger of the slope and the discrete "
        "gradient's own error.",
    )  # fmt: skip


def _by_contact(outcome: Outcome) -> Table:
    errors, rows, emphasised = outcome.error(EVENT), [], set()
    for j, cell in enumerate(outcome.cells):
        for i in np.flatnonzero(outcome.fails[:, j]):
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
        "Error of the event gradient, contact by contact, by time step. Bold where it is beyond the tolerance by more than two "
        "standard errors; — where the step is unstable or the slope not known well enough.",
        frozenset(emphasised),
    )
