"""From drawings to the figures of a report."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from experiments.report import Figure
from experiments.theme import save


def drawn(
    pictures: Mapping[str, tuple[str, Callable[[Any], Any]]], outcome: Any, folder: Path, captions: Mapping[str, str]
) -> list[Figure]:
    """Draw and save figures.

    Args:
        pictures: title, and what draws it of the outcome, by name of the file.
        outcome: the numbers.
        folder: of the run.
        captions: by the same names.

    Returns:
        The figures in the order of the pictures.
    """
    return [
        Figure(save(drawing(outcome), folder, name), title, captions[name])
        for name, (title, drawing) in pictures.items()
    ]
