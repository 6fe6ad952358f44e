"""How the figures look: one type size, few lines, colours that colour-blind readers can tell apart."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure as Picture

from experiments.report import Figure
from experiments.words import superscript

# Okabe and Ito's palette (2008); first and zeroth order keep their colours in every figure.
FIRST, ZEROTH, REFERENCE = "#d55e00", "#0072b2", "#22262e"
DEFAULT, MUTED = "#cc79a7", "#8b94a1"
_STYLE = Path(__file__).parent / "report.mplstyle"
WIDTH = 11.0  # inches; at 160 dots per inch sharp on a screen twice as dense as the page is wide

# By the name of the file: the picture of an outcome, its title of a few words, and what it shows and how to read it.
Drawings = Mapping[str, Callable[[Any], tuple[Picture, str, str]]]


def subplots(rows: int, columns: int, *, height: float, **settings):
    """Make a figure in the theme, of a height in inches, and an array (rows, columns) of axes."""
    # Titles, ticks and legends read the rules when they are made, so a context around this call would not reach them.
    plt.style.use(_STYLE)
    return plt.subplots(rows, columns, figsize=(WIDTH, height), squeeze=False, **settings)


def save(drawings: Drawings, outcome: Any, folder: Path) -> list[Figure]:
    """Draw the figures of a report into a run's folder, and let go of them."""
    (folder / "figures").mkdir(exist_ok=True)
    figures = []
    for name, drawing in drawings.items():
        picture, title, caption = drawing(outcome)
        picture.savefig(folder / "figures" / f"{name}.png")
        plt.close(picture)
        figures.append(Figure(f"figures/{name}.png", title, caption))
    return figures


def shades(count: int) -> np.ndarray:
    """Colours from light to dark for an ordered quantity, told apart by lightness alone, too."""
    return matplotlib.colormaps["viridis_r"](np.linspace(0.12, 0.98, count))


def power(value: float) -> str:
    """Write a number for an axis or a legend: 10⁴, 3×10⁵, 2500."""
    exponent = int(np.floor(np.log10(value) + 1e-12))
    mantissa = value / 10.0**exponent
    if exponent in (0, 1, 2) or (exponent == 3 and not np.isclose(mantissa, 1)):
        return f"{value:g}"
    head = "" if np.isclose(mantissa, 1) else f"{mantissa:.3g}×"
    return f"{head}10{superscript(exponent)}"
