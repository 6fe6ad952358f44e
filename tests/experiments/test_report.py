"""Numbers as a reader wants them."""

import pytest

from experiments.bias_variance.report import _with_half_width
from experiments.report import Figure, Report, Table, page
from experiments.theme import power
from experiments.words import quantity


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (-0.01182605, 0.0004, "−0.01183 ± 0.00040"),
        (123456.0, 5000.0, "(1.235 ± 0.050)×10⁵"),
        (1531.5, 12.0, "1532 ± 12"),
        (0.0, 0.02, "0.000 ± 0.020"),
        (2.5e-7, 1e-8, "(2.50 ± 0.10)×10⁻⁷"),
        (0.5, None, "0.500"),
        (12.3456, None, "12.3"),
        (0.0, None, "0.00"),
        (123456.0, None, "1.23×10⁵"),
        (float("nan"), 1.0, "undefined"),
        (1.0, float("nan"), "undefined"),
    ],
)
def test_a_number_has_the_digits_that_its_error_allows(value, error, text):
    assert quantity(value, error) == text


def test_a_gradient_has_at_most_three_digits_where_its_interval_is_smaller():
    def written(half):
        return _with_half_width({"x": 0.0021312, "x_low": 0.0021312 - half, "x_high": 0.0021312 + half}, "x")

    assert [written(7.3e-6), written(1e-4)] == ["0.00213", "0.00213 ± 0.00010"]


def test_a_power_of_ten_is_written_as_one():
    written = {250.0: "250", 1e3: "10³", 2500.0: "2500", 3e3: "3×10³", 3e5: "3×10⁵", 1e-3: "10⁻³", 3.2e-4: "3.2×10⁻⁴"}
    assert {value: power(value) for value in written} == written


def test_the_answer_comes_first_then_its_picture_then_the_rest(tmp_path):
    (tmp_path / "a.svg").write_text("<svg></svg>")
    table = Table(columns=["x"], rows=[["1"]] * 13, caption="many")
    report = Report(
        answer="It is `small`.", verdict="The verdict.", figures=[Figure("a.svg", "a", "shown")], tables=[table],
        metrics=[], warnings=["beware"],
    )  # fmt: skip
    text = page(report, tmp_path, name="n", question="Why?", expected="", about={"Settings": {"key": "value"}})
    order = ["<h1>It is <code>small</code>.", "<svg", "The verdict.", "beware", "13 rows", "Settings, time"]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert text.count("<details>") == 2, "long tables and settings are folded"
