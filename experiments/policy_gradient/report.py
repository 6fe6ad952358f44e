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
    repaired = [cell for cell in smooth if _is_biased(cell, DISCRETE) and _is_beyond(cell, DISCRETE, ONSET)]
    sentences = []
    if repaired:
        discrete, onset = ([cell.judged[gradient].bias for cell in repaired] for gradient in GRADIENTS)
        sentences.append(
            f"The discrete first-order gradient is biased at {len(repaired)} of {len(smooth)} points without a jump of the cost, "
            f"by {_span(discrete)} of the gradient's norm, where contact that begins within the step leaves {_span(onset)}."
        )
    worse = [cell for cell in smooth if _is_biased(cell, ONSET) and _is_beyond(cell, ONSET, DISCRETE)]
    sentences.append(
        f"Contact that begins within the step is worse in {joined([cell.label for cell in worse])}."
        if worse
        else "Nowhere is contact that begins within the step the worse of both beyond chance."
    )
    jumps = [cell for cell in outcome.cells if cell.hits_and_misses]
    missed = [cell for cell in jumps if _is_biased(cell, ONSET)]
    if missed:
        biases, alphas = zip(*((cell.judged[ONSET].bias, cell.judged[ONSET].alpha) for cell in missed), strict=True)
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
            one = cell.judged[gradient]
            rows.append(
                [
                    cell.label if gradient == DISCRETE else "",
                    f"{cell.norm:.3g}" if gradient == DISCRETE else "",
                    gradient,
                    f"{one.bias:.1%} ({one.low:.1%} to {one.high:.1%})",
                    quantity(one.along, one.along_error),
                    quantity(one.alpha, one.alpha_error),
                    _reasons(cell, gradient),
                    *(f"{error:.1%}" for error in one[-3:]),
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
    return cell.judged[gradient].low > 0 and cell.judged[gradient].bias > NEGLIGIBLE


def _is_beyond(cell: Cell, larger: str, smaller: str) -> bool:
    return cell.judged[larger].low > cell.judged[smaller].high


def _change(cell: Cell) -> float:
    """How far apart both first-order means are, over the norm of the gradient; from the same rollouts."""
    onset, discrete = (cell.estimates[gradient].first.mean(axis=0) for gradient in (ONSET, DISCRETE))
    return float(np.linalg.norm(onset - discrete)) / cell.norm


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
