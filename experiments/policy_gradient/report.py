"""The answer of the experiment on policy gradients in words, computed from its numbers."""

from collections.abc import Callable, Sequence

import numpy as np

from experiments.policy_gradient.outcome import DISCRETE, ESTIMATORS, GRADIENTS, ONSET, Cell, Outcome
from experiments.report import Table
from experiments.words import joined, percent, quantity
from mjxgrad.estimators import Reason

NEGLIGIBLE = 0.05
"""Of the gradient's norm: a bias below it matters to no descent."""


def verdict(outcome: Outcome) -> str:
    """Say where which first-order estimate is right."""
    smooth = [cell for cell in outcome.cells if not cell.hits_and_misses]
    repaired = [cell for cell in smooth if _is_biased(cell, DISCRETE) and _is_better(cell)]
    sentences = []
    if repaired:
        discrete, onset = ([cell.bias(gradient)[0] for cell in repaired] for gradient in GRADIENTS)
        sentences.append(
            f"The discrete first-order gradient is biased at {len(repaired)} of {len(smooth)} points without a jump of the cost, "
            f"by {_span(discrete)} of the gradient's norm, where contact that begins within the step leaves {_span(onset)}."
        )
    worse = [cell for cell in smooth if _is_biased(cell, ONSET) and cell.bias(ONSET)[1] > cell.bias(DISCRETE)[2]]
    sentences.append(
        f"Contact that begins within the step is worse in {joined([cell.label for cell in worse])}."
        if worse
        else "Nowhere is contact that begins within the step the worse of both beyond chance."
    )
    jumps = [cell for cell in outcome.cells if cell.hits_and_misses]
    missed = [cell for cell in jumps if _is_biased(cell, ONSET)]
    if missed:
        biases, alphas = zip(*((cell.bias(ONSET)[0], cell.alpha(ONSET)[0]) for cell in missed), strict=True)
        sentences.append(
            f"Hit or miss it does not see: at {len(missed)} of {len(jumps)} points where the noise covers a jump it is biased by "
            f"{_span(biases)}, and α-order gives it a weight of {_span(alphas, '{:.2f}'.format)}."
        )
    return " ".join(sentences)


def findings(outcome: Outcome) -> list[str]:
    """Say whether an onset does harm where contact sets in gently."""
    gentle = [cell for cell in outcome.cells if not cell.has_jump_of_force]
    if not gentle:
        return []
    cell = max(gentle, key=_change)
    return [
        f"Where contact sets in gently it changes the first-order mean by at most {_change(cell):.1%} of the "
        f"gradient ({cell.label})."
    ]


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate both gradients at every point, and the descents."""
    rows, emphasised = [], set()
    for cell in outcome.cells:
        for gradient in GRADIENTS:
            if _is_biased(cell, gradient):
                emphasised.add((len(rows), 3))
            alpha, alpha_error = cell.alpha(gradient)
            rows.append(
                [
                    cell.label if gradient == DISCRETE else "",
                    f"{cell.norm:.3g}" if gradient == DISCRETE else "",
                    gradient,
                    _bias(cell, gradient),
                    quantity(*cell.along(gradient)),
                    quantity(alpha, alpha_error),
                    _reasons(cell, gradient),
                    *(f"{cell.error(gradient, kind):.1%}" for kind in ("first", "unbiased", "mixed")),
                ]
            )
    columns = (
        "task", "norm of the gradient", "derivative", "bias, first order", "component along", "α", "why (share of estimates)",
        "error, first order", "error, unbiased", "error, α-order",
    )  # fmt: skip
    caption = (
        "Bias and errors over the norm of the gradient. Bias: of the mean, noise taken off, in brackets two standard errors "
        "to either side; bold where it is not chance and above five per cent. Component along the reference: 1 is right. Errors: "
        "root mean square of one estimate."
    )
    found = [Table(columns, rows, caption, frozenset(emphasised)), _descents(outcome)]
    return [table for table in found if table.rows]


def _descents(outcome: Outcome) -> Table:
    rows = [
        [
            course.title,
            ESTIMATORS[course.estimator],
            course.gradient,
            f"{course.costs[:, 0].mean():.4g}".replace("-", "−"),
            quantity(*course.final),
            f"{course.alphas[:, :-1].mean():.2f}",
            f"{course.seconds:.1f}",
        ]
        for course in outcome.courses
    ]
    columns = ("task", "estimator", "derivative", "cost at the start", "final cost", "mean α", "s")
    return Table(
        columns, rows, "Descents; costs under noise, mean and standard deviation over seeds; time of all seeds."
    )


def _is_biased(cell: Cell, gradient: str) -> bool:
    """Say whether a bias is beyond chance, and worth speaking of."""
    bias, low, _ = cell.bias(gradient)
    return low > 0 and bias > NEGLIGIBLE


def _is_better(cell: Cell) -> bool:
    return cell.bias(ONSET)[2] < cell.bias(DISCRETE)[1]


def _change(cell: Cell) -> float:
    """How far apart both first-order means are, over the norm of the gradient; from the same rollouts."""
    return float(np.linalg.norm(cell.first_mean(ONSET)[0] - cell.first_mean(DISCRETE)[0])) / cell.norm


def _bias(cell: Cell, gradient: str) -> str:
    bias, low, high = cell.bias(gradient)
    return f"{bias:.1%} ({low:.1%} to {high:.1%})"


def _reasons(cell: Cell, gradient: str) -> str:
    """Name the rule's reasons in a word each, with their shares."""
    words = {
        "inconsistent": "contradictory",
        "inverse_variance": "trusted",
        "bias_limit": "biased",
        "uncertain": "uncertain",
    }
    reasons = cell.estimates[gradient].reason
    shares = {word: float(np.mean(reasons == getattr(Reason, name)._value)) for name, word in words.items()}
    return ", ".join(f"{word} {share:.0%}" for word, share in shares.items() if share > 0)


def _span(values: Sequence[float], write: Callable[[float], str] = percent) -> str:
    return " to ".join(dict.fromkeys(map(write, (min(values), max(values)))))
