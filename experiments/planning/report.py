"""What the plans say, in sentences and in a table."""

from experiments.planning.outcome import Attempt, Outcome
from experiments.planning.settings import NAMES
from experiments.report import Table
from experiments.words import quantity


def verdict(outcome: Outcome) -> str:
    """Answer the question from the data: which linear models solve the task, and what the others do."""
    return " ".join(_one(outcome, model) for model in outcome.settings.models)


def findings(outcome: Outcome) -> list[str]:
    """List one sentence per further finding."""
    sentences = []
    best = outcome.shown[-1]
    off = max(abs(best - outcome.best.states[-1, :5]))
    sentences.append(
        f"A rollout of the scene under the plan that was kept ends where the planner says, up to {off:.0e} (m, rad)."
    )
    if outcome.polished is not None:
        before, after = outcome.shortest(outcome.settings.models[0]), outcome.polished
        sentences.append(
            f"Trajectory optimisation took the shortest way of {len(before.controls)} steps from {_end(outcome, before)} to "
            f"{_end(outcome, after)}, and its cost from {quantity(after.course['cost'][0])} to "
            f"{quantity(after.course['cost'].min())}, in {after.seconds:.0f} s."
        )
    if outcome.settings.method == "trajectory":
        for attempt in outcome.attempts:
            lost = int((attempt.course["step"] == 0).sum())
            if attempt.model != "none" and lost:
                sentences.append(
                    f"With {attempt.label} models {lost} of {len(attempt.course['step'])} iterations found no better step."
                )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the attempts."""
    columns = [
        "linear models",
        "seed",
        "solved",
        "rod from goal",
        "turn from goal",
        "steps",
        "nodes",
        "time with compilation",
    ]
    rows = []
    for attempt in outcome.attempts:
        rows.append([
            attempt.label,
            str(attempt.seed),
            "yes" if outcome.is_solved(attempt) else "no",
            f"{1e3 * outcome.distance(attempt):.1f} mm",
            f"{outcome.angle(attempt):.3f} rad",
            str(len(attempt.controls)),
            "" if attempt.nodes is None else str(len(attempt.nodes)),
            f"{attempt.seconds:.0f} s",
        ])  # fmt: skip
    return [Table(columns, rows, "Every attempt; later seeds of a kind use the compiled program of the first.")]


def _one(outcome: Outcome, model: str) -> str:
    """Say how one kind of linear model did."""
    attempts, name = outcome.of(model), NAMES[model]
    name = name if model == "none" else f"{name} models"
    solved = [attempt for attempt in attempts if outcome.is_solved(attempt)]
    best = outcome.shortest(model)
    if len(attempts) == 1:
        return f"With {name} the rod {_fate(outcome, best)} ({best.seconds:.0f} s, compilation included)."
    if solved:
        return (
            f"With {name} {len(solved)} of {len(attempts)} trees find a way, the shortest of {len(best.controls)} steps "
            f"({best.seconds:.0f} s; {max(one.seconds for one in attempts):.0f} s the slowest, compilation included)."
        )
    return f"With {name} none of {len(attempts)} trees finds a way; in the best the rod {_fate(outcome, best)}."


def _fate(outcome: Outcome, attempt: Attempt) -> str:
    if outcome.is_solved(attempt):
        return f"reaches its goal up to {_end(outcome, attempt)}"
    if outcome.moved(attempt) == 0:
        return "does not move at all"
    return f"ends {_end(outcome, attempt)} from its goal"


def _end(outcome: Outcome, attempt: Attempt) -> str:
    return f"{1e3 * outcome.distance(attempt):.1f} mm and {outcome.angle(attempt):.3f} rad"
