"""The answer of the experiment on billiards in words, computed from its numbers."""

from experiments.billiards import hard
from experiments.billiards.measure import IDLE, Outcome, Run
from experiments.report import Table
from experiments.words import capitalised, joined


def verdict(outcome: Outcome) -> str:
    """Say what solves the stroke from balls that do not touch, and what does not."""
    apart = [run for run in outcome.runs if not run.touches_at_start]
    solved, stuck = [run for run in apart if run.is_solved], [run for run in apart if run.is_stuck]
    between = [run for run in apart if not run.is_solved and not run.is_stuck]
    sentences = []
    if solved:
        sentences.append(
            f"From balls that do not touch, {_listed(solved)} reach the optimum of {hard.optimum()[0]:.4f} to one per cent, "
            "also when hard balls play their forces."
        )
    if rest := [
        *([f"no progress beyond standing still (cost {IDLE:g}): {_listed(stuck)}"] if stuck else []),
        *([f"in between: {_listed(between)}"] if between else []),
    ]:
        sentences.append(capitalised("; ".join(rest)) + ".")
    touching = [run for run in outcome.runs if run.touches_at_start]
    if touching:
        sentences.append(f"From a start that touches: {'; '.join(map(_ending, touching))}.")
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say what costs of soft and hard balls mean beside each other."""
    best, time, speed = hard.optimum()
    return [
        f"Hard balls collide in no time (another program: closed forms and root finding); their optimum over all forces is "
        f"{best:.6f}, as published, with a hit after {time:.3f} s at {speed:.2f} m/s. The simulated cost may lie below that by "
        "half a per cent: a soft collision takes time, in which the driven ball goes on pushing."
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    rows = []
    for run in outcome.runs:
        costs = [f"{cost:.4f}" for cost in (run.cost[0], run.final_cost, run.hard_cost)]
        seconds = [f"{time:.1f}" for time in (run.seconds, run.compile_seconds)]
        touches = "yes" if run.touches_at_start else "no"
        rows.append([run.method.label, touches, *costs, str(run.num_rollouts), *seconds])
    costs = ("cost at the start", "best cost", "with hard balls")
    columns = ("method", "touches at the start", *costs, "rollouts", "s", "s compiling")
    solved = frozenset((i, 3) for i, run in enumerate(outcome.runs) if run.is_solved)
    caption = "Costs in m², without noise; bold where the stroke is solved to one per cent."
    return [Table(columns, rows, caption, solved)]


def _listed(runs: list[Run]) -> str:
    return joined(f"{run.method.label} ({run.final_cost:.3f})" for run in runs)


def _ending(run: Run) -> str:
    what = "solved" if run.is_solved else "no progress" if run.is_stuck else "in between"
    return f"{run.method.label}: {what} ({run.final_cost:.3f})"
