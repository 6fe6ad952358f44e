"""The answer of the rolling pin's experiment in words, computed from its numbers."""

from experiments.report import Table
from experiments.rolling_pin.outcome import Descent, Outcome
from experiments.words import quantity


def verdict(outcome: Outcome) -> str:
    """Say what plain first order did, and what solved the task."""
    plain, settings = outcome.plain, outcome.settings
    if outcome.start_gradient == 0 and not plain.has_moved:
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
    parts = [told]
    if solved:
        named = ", ".join(f"{one.label} ({quantity(one.costs[-1])})" for one in solved)
        parts.append(f"Solved, with a true cost below {settings.solved_below:g} of the untouched bed's 1, by {named}.")
    if failed:
        parts.append(f"Not solved by {', '.join(f'{one.label} ({quantity(one.costs[-1])})' for one in failed)}.")
    return " ".join(parts)


def findings(outcome: Outcome) -> list[str]:
    """Single findings, one sentence each."""
    solved = [(steps, one) for one in outcome.descents if (steps := _steps(outcome, one)) is not None]
    sentences = []
    if solved:
        steps, first = min(solved, key=lambda pair: pair[0] * pair[1].num_samples)
        count = steps * first.num_samples
        sentences.append(f"With the fewest rollouts it is solved by {first.label}: {count} of them in {steps} steps.")
    if lost := sum(one.num_skipped for one in outcome.descents):
        sentences.append(f"{lost} steps were left out, because their estimate was not finite.")
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate all descents."""
    rows, emphasised = [], set()
    for row, one in enumerate(outcome.descents):
        steps = _steps(outcome, one)
        if outcome.is_solved(one):
            emphasised.add((row, 2))
        off = 1e3 * abs(outcome.heights[one.label] - outcome.target).max()
        rows.append(
            [
                one.label,
                str(one.num_samples),
                quantity(float(one.costs[-1])),
                quantity(float(one.costs.min())),
                "never" if steps is None else str(steps),
                "" if steps is None else str(steps * one.num_samples),
                f"{off:.1f}",
            ]
        )
    below = f"{outcome.settings.solved_below:g}"
    columns = (
        "descent along", "rollouts a step", "final true cost", "least true cost", f"steps to stay below {below}",
        "rollouts for that", "worst pillar (mm)",
    )  # fmt: skip
    caption = (
        "The true cost is that of the scene as it is, without noise, whatever the descent saw; 1 is the untouched bed. "
        f"In bold what ends below {below}. The last column is the largest distance of a pillar from its wanted height "
        "in the end."
    )
    return [Table(columns, rows, caption, frozenset(emphasised))]


def _steps(outcome: Outcome, one: Descent) -> int | None:
    return one.steps_to(outcome.settings.solved_below)
