"""How the figures look: one type size, few lines, colours that colour-blind readers can tell apart."""

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import FuncFormatter, NullFormatter

from experiments.report import Figure
from experiments.words import superscript
from mjxgrad.report import INK, STYLE, svg

# Okabe and Ito's palette (2008).
FIRST, ZEROTH, REFERENCE = "#d55e00", "#0072b2", INK
DEFAULT, MUTED, ONSET = "#cc79a7", "#8b94a1", "#009e73"
# Of a method in every figure.
COLOURS = {
    "first order": FIRST,
    "zeroth order": ZEROTH,
    "zeroth order (zero noise)": "#56b4e9",
    "control variate": DEFAULT,
    "α-order": ONSET,
    "α-order (bias constrained)": "#b58900",
    "α-order (concavity)": "#6b6ecf",
    "α-order (inverse variance)": "#843c39",
    "REINFORCE": "#7f3c8d",
    "cross-entropy": "#3b4452",
    "MPPI": "#8c6d31",
    "predictive sampling": MUTED,
}
# For what comes besides, in order; told apart by their markers, too.
OTHERS = (ONSET, DEFAULT, "#e69f00", "#56b4e9", "#8c6d31", "#6b6ecf", MUTED, "#393b79", "#17becf", "#bcbd22", "#e377c2")
MARKERS = "osD^vP*X<>"
WIDTH = 11.0  # inches, of a page

# By the name of the file: a picture, its title of a few words, and what it shows and how to read it.
Drawings = Mapping[str, tuple[Picture, str, str]]


def subplots(rows: int, columns: int, *, height: float, **settings):
    """Make a figure in the theme, of a height in inches, and an array (rows, columns) of axes."""
    # Titles, ticks and legends read the rules when they are made, so a context around this call would not reach them.
    plt.style.use(STYLE)
    return plt.subplots(rows, columns, figsize=(WIDTH, height), squeeze=False, **settings)


def panel(height: float) -> tuple[Picture, Axes]:
    """Make a figure of one panel, of a height in inches."""
    figure, axes = subplots(1, 1, height=height)
    return figure, axes[0, 0]


def save(drawings: Drawings, folder: Path) -> list[Figure]:
    """Write the figures of a report into a run's folder, and let go of them."""
    (folder / "figures").mkdir(exist_ok=True)
    figures = []
    for name, (picture, title, caption) in drawings.items():
        file = f"figures/{name}.svg"
        (folder / file).write_text(svg(lambda picture=picture: picture, title), encoding="utf-8")
        figures.append(Figure(file, title, caption))
    return figures


def shades(count: int) -> np.ndarray:
    """Colours from light to dark for an ordered quantity, told apart by lightness alone, too."""
    return matplotlib.colormaps["viridis_r"](np.linspace(0.12, 0.98, count))


def power(value: float) -> str:
    """Write a number for an axis or a legend: 10⁴, 3×10³, 2500."""
    exponent = int(np.floor(np.log10(value) + 1e-12))
    mantissa = value / 10.0**exponent
    # 3×10³ stands beside 10³ and 10⁴; 2500 is shorter than its power.
    if exponent in (0, 1, 2) or (exponent == 3 and not np.isclose(mantissa, round(mantissa))):
        return f"{value:g}"
    head = "" if np.isclose(mantissa, 1) else f"{mantissa:.3g}×"
    return f"{head}10{superscript(exponent)}"


def looks(labels: Iterable[str]) -> list[dict[str, Any]]:
    """Give each line its colour and marker; methods have their colours everywhere, others those that are left."""
    labels = list(labels)
    taken = {COLOURS.get(label) for label in labels}
    others = itertools.cycle(colour for colour in OTHERS if colour not in taken)
    pairs = zip(labels, itertools.cycle(MARKERS))
    return [{"color": COLOURS.get(label) or next(others), "marker": marker} for label, marker in pairs]


def logarithmic(*axes: Axis) -> None:
    """Make axes logarithmic, with numbers at whole powers of ten alone."""
    for axis in axes:
        axis.axes.set(**{f"{axis.axis_name}scale": "log"})
        axis.set_minor_formatter(NullFormatter())


def legend_below(figure: Picture, axes: Axes | Iterable[Axes], columns: int) -> None:
    """Name under the panels what one or several of them show."""
    shown = [axes] if isinstance(axes, Axes) else axes
    handles = [handle for axis in shown for handle in axis.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(columns, len(handles)), fontsize=8.5)


def plain(axis: Axis) -> None:
    """Write the numbers of a logarithmic axis without powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))


def errorbar(axis: Axes, x: np.ndarray, value: np.ndarray, ends: np.ndarray, **look: Any) -> None:
    """Draw values with the ends (low, high) of their intervals."""
    # An end may lie beyond its value by rounding alone.
    errors = np.maximum([value - ends[0], ends[1] - value], 0)
    axis.errorbar(x, value, errors.reshape(2, -1), **({"lw": 1.0, "elinewidth": 1.1, "capsize": 2} | look))
