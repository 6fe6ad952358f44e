"""Pages and figures: what stands in them is text, and they fit light and dark."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

plt = pytest.importorskip("matplotlib.pyplot")
pytest.importorskip("jinja2")

from mjxgrad.report import INK, Block, Table, page, svg  # noqa: E402

SCRIPT = "<script>alert(1)</script>"


def figure(title="a", size=(4, 2)):
    made, axis = plt.subplots(figsize=size)
    axis.plot([0, 1], [0, 1], color="#0072b2")
    axis.set_title(title)
    return made


def test_the_answer_is_the_first_line():
    text = page("It is `small`.", "what: why", [Block(text="More.")])
    assert re.sub(r"\s+", " ", text).partition("<main> ")[2].startswith("<h1>It is <code>small</code>.</h1>")


def test_no_line_ends_between_a_number_and_its_unit():
    text = page("It takes 0.068 s a gradient, 9.2 % off at 6 m/s, in 3 steps.", "why", [])
    assert "0.068\xa0s a gradient, 9.2\xa0% off at 6\xa0m/s, in 3 steps" in text.partition("<h1>")[2]


def test_names_are_text_wherever_they_stand():
    table = Table([SCRIPT], [[SCRIPT]], caption=SCRIPT)
    drawn = svg(lambda: figure(SCRIPT), SCRIPT)
    block = Block(
        title=SCRIPT, lead=SCRIPT, text=SCRIPT, drawings=[drawn], caption=SCRIPT, items=[SCRIPT], faults=[SCRIPT],
        table=table, code=SCRIPT, folded=SCRIPT,
    )  # fmt: skip
    card = {"href": "a", "figure": None, "video": None, "about": SCRIPT, "title": SCRIPT, "text": f"`{SCRIPT}`"}
    text = page(SCRIPT, SCRIPT, [block], [card])
    assert "<script" not in text
    assert text.count("&lt;script&gt;") == 21


def test_text_of_a_figure_has_the_colour_of_the_page_and_other_colours_one_for_each_scheme():
    drawn = svg(figure, "a")
    assert INK not in drawn.partition(">")[2]
    assert "fill: currentColor" in drawn
    assert "stroke: #0072b2; stroke: light-dark(#0072b2, oklch(from #0072b2 max(0.6, 1.21 - l) c h))" in drawn
    assert "fill: #ffffff" not in drawn, "no sheet of its own"


def test_two_figures_of_a_page_share_no_name_and_fetch_nothing():
    text = page("Yes.", "two", [Block(drawings=[svg(figure, "first"), svg(figure, "second")])])
    names = re.findall(r'\bid="([^"]*)"', text)
    assert names
    assert len(set(names)) == len(names)
    assert "http" not in text


@pytest.mark.parametrize(("width", "is_wide"), [(4, False), (11, True)])
def test_only_a_wide_figure_keeps_its_width_on_a_telephone(width, is_wide):
    assert ('class="wide"' in svg(lambda: figure(size=(width, 2)), "a")) is is_wide


def test_a_notebooks_backend_keeps_what_it_sets_when_a_page_is_the_first_to_draw(tmp_path):
    """Backends such as that of notebooks switch interactive drawing on; without it later figures are not shown."""
    (tmp_path / "shown.py").write_text(
        "from matplotlib.backends.backend_agg import *\nimport matplotlib\nmatplotlib.interactive(True)\n"
    )
    code = "import matplotlib; from mjxgrad.report import svg; import importlib"
    code += (
        "; svg(lambda: importlib.import_module('matplotlib.pyplot').figure(), 'a'); assert matplotlib.is_interactive()"
    )
    environment = os.environ | {"MPLBACKEND": "module://shown", "PYTHONPATH": f"{tmp_path}:{Path.cwd()}"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
