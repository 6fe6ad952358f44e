"""How the figures look: one type size, few lines, colours that colour-blind readers can tell apart."""

import itertools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import FuncFormatter

from experiments.report import Figure
from experiments.words import superscript

# Okabe and Ito's palette (2008); first and zeroth order keep their colours in every figure.
FIRST, ZEROTH, REFERENCE = "#d55e00", "#0072b2", "#22262e"
DEFAULT, MUTED, ONSET = "#cc79a7", "#8b94a1", "#009e73"
# For what comes besides, in order; told apart by their markers, too.
OTHERS = (ONSET, DEFAULT, "#e69f00", "#56b4e9", "#8c6d31", "#6b6ecf", MUTED, "#393b79")
MARKERS = "osD^vP*X<>"
WIDTH = 11.0  # inches; at 160 dots per inch sharp on a screen twice as dense as the page is wide

# By the name of the file: the picture of an outcome, its title of a few words, and what it shows and how to read it.
Drawings = Mapping[str, Callable[[Any], tuple[Picture, str, str]]]

RULES: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.labelcolor": "#3b4452",
    "axes.edgecolor": "#9aa3af",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=[FIRST, ZEROTH, "#009e73", "#cc79a7", "#e69f00", "#56b4e9"]),
    "axes.grid": True,
    "grid.color": "#e8eaed",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "xtick.color": "#9aa3af",
    "ytick.color": "#9aa3af",
    "xtick.labelcolor": "#3b4452",
    "ytick.labelcolor": "#3b4452",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.6,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 160,
    "savefig.facecolor": "white",
}


def subplots(rows: int, columns: int, *, height: float, **settings):
    """Make a figure in the theme.

    Args:
        rows: of axes.
        columns: of axes.
        height: of the figure, in inches.
        **settings: as for `matplotlib.pyplot.subplots`.

    Returns:
        The figure, and an array (rows, columns) of axes.
    """
    # Titles, ticks and legends read the rules when they are made, so a context around this call would not reach them.
    plt.rcParams.update(RULES)
    return plt.subplots(rows, columns, figsize=(WIDTH, height), squeeze=False, **settings)


def save(drawings: Drawings, outcome: Any, folder: Path) -> list[Figure]:
    """Draw figures, write them, and let go of them.

    Args:
        drawings: pictures made by `subplots`.
        outcome: the numbers.
        folder: of the run.

    Returns:
        The figures of the report.
    """
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


def looks(labels: Iterable[str]) -> list[dict[str, Any]]:
    """Give each line its colour and marker; first and zeroth order have their colours everywhere."""
    fixed, others = {"first order": FIRST, "zeroth order": ZEROTH}, itertools.cycle(OTHERS)
    pairs = zip(labels, itertools.cycle(MARKERS))
    return [{"color": fixed.get(label) or next(others), "marker": marker} for label, marker in pairs]


def legend_below(figure: Picture, axis: Axes, columns: int) -> None:
    """Name under the panels what one of them shows."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, len(labels)), fontsize=8.5)


def plain(axis: Axis) -> None:
    """Write the numbers of a logarithmic axis without powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))


def errorbar(axis: Axes, x: np.ndarray, value: np.ndarray, ends: np.ndarray, **look: Any) -> None:
    """Draw values with the ends (low, high) of their intervals."""
    # An end may lie beyond its value by rounding alone.
    errors = np.maximum([value - ends[0], ends[1] - value], 0)
    axis.errorbar(x, value, errors.reshape(2, -1), **({"lw": 1.0, "elinewidth": 1.1, "capsize": 2} | look))
