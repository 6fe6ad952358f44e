"""The answer of the rolling pin's experiment in words, computed from its numbers."""

import numpy as np

from experiments.report import Table
from experiments.rolling_pin.measure import Descent, Outcome
from experiments.words import joined, quantity


def verdict(outcome: Outcome) -> str:
    """Say what plain first order did, and what solved the task."""
    settings = outcome.settings
    plain = next(one for one in outcome.descents if one.label == "first order")
    has_moved = np.ptp(plain.costs) > 1e-6 * plain.costs[0]
    if outcome.start_gradient == 0 and not has_moved:
        told = (
            "First order stays at the start: its gradient is zero, exactly, and after "
            f"{settings.num_steps} steps the bed is untouched."
        )
    else:
        told = (
            f"First order begins with a gradient of {quantity(outcome.start_gradient)} and ends at a true cost of "
            f"{quantity(plain.costs[-1])}."
        )
    solved = sorted((one for one in outcome.descents if outcome.is_solved(one)), key=lambda one: one.costs[-1])
    failed = [one for one in outcome.descents if not outcome.is_solved(one) and one is not plain]
    below = f"with a true cost below {settings.solved_below:g} of the untouched bed's 1"
    return " ".join(
        [
            told,
            *([f"Solved, {below}, by {_listed(solved)}."] if solved else []),
            *([f"Not solved by {_listed(failed)}."] if failed else []),
        ]
    )


def findings(outcome: Outcome) -> list[str]:
    """Say how many steps had no estimate."""
    lost = sum(one.num_skipped for one in outcome.descents)
    return [f"{lost} steps were left out, because their estimate was not finite."] if lost else []


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    target, below = np.asarray(outcome.task.target), f"{outcome.settings.solved_below:g}"
    rows = []
    for one in outcome.descents:
        steps = one.steps_to(outcome.settings.solved_below)
        reached = ["never", ""] if steps is None else [str(steps), str(steps * one.num_samples)]
        costs = [quantity(float(cost)) for cost in (one.costs[-1], one.costs.min())]
        worst = f"{1e3 * abs(one.heights - target).max():.1f}"
        rows.append([one.label, str(one.num_samples), *costs, *reached, worst])
    columns = (
        "descent along", "rollouts a step", "final true cost", "least true cost", f"steps to stay below {below}",
        "rollouts for that", "worst pillar (mm)",
    )  # fmt: skip
    caption = (
        "The true cost is that of the scene as it is, without noise, whatever the descent saw; 1 is the untouched bed. "
        f"In bold what ends below {below}. The last column is the largest distance of a pillar from its wanted height "
        "in the end."
    )
    solved = frozenset((row, 2) for row, one in enumerate(outcome.descents) if outcome.is_solved(one))
    return [Table(columns, rows, caption, solved)]


def _listed(descents: list[Descent]) -> str:
    return joined(f"{one.label} ({quantity(one.costs[-1])})" for one in descents)
