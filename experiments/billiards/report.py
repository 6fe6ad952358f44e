"""The answer of the experiment on billiards in words, computed from its numbers."""

from collections.abc import Sequence

from experiments.billiards.outcome import IDLE, Outcome, Run
from experiments.report import Table


def verdict(outcome: Outcome) -> str:
    """Say what solves the stroke from balls that do not touch, and what does not."""
    apart = [run for run in outcome.runs if not run.has_touched]
    solved, stuck = [run for run in apart if run.is_solved], [run for run in apart if run.is_stuck]
    between = [run for run in apart if run not in solved and run not in stuck]
    parts = []
    if solved:
        parts.append(
            f"From balls that do not touch, {_listed(solved)} reach the optimum of {outcome.optimum[0]:.4f} to one per cent, "
            "also when hard balls play their forces."
        )
    if stuck:
        parts.append(f"No progress beyond standing still (cost {IDLE:g}): {_listed(stuck)}.")
    if between:
        ends = ", ".join(
            f"{run.method.label} ({run.final_cost:.3f}; with hard balls {run.hard_cost:.3f})" for run in between
        )
        parts.append(f"In between: {ends}.")
    touching = [run for run in outcome.runs if run.has_touched]
    if touching:
        ends = "; ".join(f"{run.method.label}: {_ending(run)}" for run in touching)
        parts.append(f"From a start that touches: {ends}.")
    return " ".join(parts)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    best = min(outcome.runs, key=lambda run: run.hard_cost)
    return [
        f"Played on balls that collide in no time (another program: closed forms and root finding), the forces of "
        f"{best.method.label} cost {best.hard_cost:.4f}; the optimum over all forces is {outcome.optimum[0]:.6f}, as published.",
        "The simulated cost may lie below that by half a per cent: a soft collision takes time, in which the driven ball "
        "goes on pushing.",
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    rows = [
        [
            run.method.label,
            "yes" if run.has_touched else "no",
            f"{run.cost[0]:.3f}",
            f"{run.final_cost:.4f}",
            f"{run.hard_cost:.4f}",
            str(run.num_rollouts),
            f"{run.seconds:.1f}",
            f"{run.compile_seconds:.1f}",
        ]
        for run in outcome.runs
    ]
    solved = frozenset((i, 3) for i, run in enumerate(outcome.runs) if run.is_solved)
    columns = (
        "method",
        "touches at the start",
        "cost at the start",
        "best cost",
        "with hard balls",
        "rollouts",
        "s",
        "s compiling",
    )
    return [
        Table(columns, rows, "Costs in m², without noise; bold where the stroke is solved to one per cent.", solved)
    ]


def _listed(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.method.label} ({run.final_cost:.3f})" for run in runs)


def _ending(run: Run) -> str:
    if run.is_solved:
        return f"solved ({run.final_cost:.3f})"
    return f"no progress ({run.final_cost:.3f})" if run.is_stuck else f"ends at {run.final_cost:.3f}"
