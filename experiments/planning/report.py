"""What the plans say, in sentences and in a table."""

from experiments.planning.measure import Attempt, Outcome
from experiments.planning.settings import NAMES
from experiments.report import Table
from experiments.words import capitalised, quantity


def verdict(outcome: Outcome) -> str:
    """Answer the question from the data: which linear models solve the task, and what the others do."""
    return capitalised("; ".join(_one(outcome, model) for model in outcome.settings.models)) + "."


def _one(outcome: Outcome, model: str) -> str:
    """Say how one kind of linear model did."""
    attempts, best = outcome.of(model), outcome.shortest(model)
    name = NAMES[model] if model == "none" else f"{NAMES[model]} models"
    num_solved = sum(map(outcome.is_solved, attempts))
    if len(attempts) > 1:
        ways = f"a way, the shortest of {len(best.controls)} steps" if num_solved else "a way"
        return f"with {name} {num_solved or 'none'} of {len(attempts)} trees {'find' if num_solved else 'finds'} {ways}"
    if num_solved:
        return f"with {name} the rod reaches its goal"
    fate = "does not move at all" if outcome.moved(best) == 0 else f"ends {_end(outcome, best)} from its goal"
    return f"with {name} the rod {fate}"


def _end(outcome: Outcome, attempt: Attempt) -> str:
    return f"{1e3 * outcome.distance(attempt):.1f} mm and {outcome.angle(attempt):.3f} rad"


def findings(outcome: Outcome) -> list[str]:
    """Hold the plan against the scene, and say what polishing gained."""
    off = max(abs(outcome.shown[-1] - outcome.best.states[-1, :5]))
    sentences = [
        f"A rollout of the scene under the plan that was kept ends where the planner says, up to {off:.0e} (m, rad)."
    ]
    if outcome.polished is not None:
        before, after = outcome.shortest(outcome.settings.models[0]), outcome.polished
        sentences.append(
            f"Trajectory optimisation took the shortest way of {len(before.controls)} steps from {_end(outcome, before)} to "
            f"{_end(outcome, after)}, and its cost from {quantity(after.course['cost'][0])} to "
            f"{quantity(after.course['cost'].min())}, in {after.seconds:.0f} s."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate the attempts."""
    is_tree = outcome.settings.method == "tree"
    columns = (
        "linear models", "seed", "solved", "rod from goal", "turn from goal", "steps",
        "nodes" if is_tree else "iterations without a better step", "time with compilation",
    )  # fmt: skip
    rows = [
        [
            attempt.label,
            str(attempt.seed),
            "yes" if outcome.is_solved(attempt) else "no",
            f"{1e3 * outcome.distance(attempt):.1f} mm",
            f"{outcome.angle(attempt):.3f} rad",
            str(len(attempt.controls)),
            str(len(attempt.course["error"]))
            if is_tree
            else f"{(attempt.course['step'] == 0).sum()} of {len(attempt.course['step'])}",
            f"{attempt.seconds:.0f} s",
        ]
        for attempt in outcome.attempts
    ]
    return [Table(columns, rows, "Every attempt; later seeds of a kind use the compiled program of the first.")]
