"""The risk bench: its errors are those of closed forms, and it says what they are."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.stats import norm

from experiments import alpha_risk
from experiments.alpha_risk import (
    ALPHA,
    FIRST_ORDER,
    ZEROTH_ORDER,
    Outcome,
    Settings,
    answer,
    drawings,
    tables,
    verdict,
)

SETTINGS = Settings(
    experiment="alpha_risk",
    textbook=("heaviside",),
    points=(0.0,),
    dims=(1, 5),
    tasks=("lqr",),
    later=0,
    walls=(),
    robots=(),
    batches=(16, 64),
    num_samples=512,
    num_truth=4000,
)


@pytest.fixture(scope="module")
def outcome():
    problems = alpha_risk._problems(SETTINGS)[:2]
    return Outcome(
        SETTINGS, [c for i, make in enumerate(problems) for c in alpha_risk._cells(make, SETTINGS, jax.random.key(i))]
    )


def test_errors_of_a_step_are_those_of_its_closed_form(outcome):
    """First order misses all of it; Var[(H - 1/2) w/σ²] = 1/4σ² - (φ(0)/σ)², and the leave-one-out mean adds 1/4σ²(n - 1)."""
    slope = norm.pdf(0)
    for cell in outcome.cells:
        assert cell.error[FIRST_ORDER] == pytest.approx(1, rel=1e-9)
        assert cell.bias == pytest.approx(1, rel=1e-9)
        count = cell.batch
        exact = ((0.25 - slope**2) / count + (0.25 + slope**2) / (count * (count - 1))) / slope**2
        # One coordinate's noise comes on top of the jumps of all the others, of a quarter each.
        exact += (cell.dim - 1) * 0.25 / (count - 1) / slope**2
        assert abs(cell.error[ZEROTH_ORDER] - exact) < 4 * cell.spread[ZEROTH_ORDER] + 0.02 * exact


def test_the_page_says_how_far_alpha_order_is_from_the_better_part(outcome):
    assert "times the better part's error" in answer(outcome)
    assert len(answer(outcome).split()) <= 15
    assert f"of {len(outcome.cells)} cells α-order is below both parts" in verdict(outcome)
    (table,) = tables(outcome)
    assert len(table.rows) == len(outcome.rows()) == 4
    for cell in outcome.cells:
        low, high = cell.ratio_interval
        assert low <= cell.ratio <= high
        assert cell.ratio == pytest.approx(
            cell.error[ALPHA] / min(cell.error[FIRST_ORDER], cell.error[ZEROTH_ORDER]), rel=1e-9
        )
    figure, _, caption = drawings(outcome)["risk"]
    assert len(figure.axes) == 2
    assert "near 1 or below" in caption


def test_the_bias_is_what_noise_does_not_explain():
    noise = np.random.default_rng(0).normal(size=(400, 3))
    truth = np.array([3.0, 0.0, 4.0])
    assert alpha_risk._bias(truth + 0.1 * noise, truth, 0.0) < 0.005
    assert alpha_risk._bias(1.2 * truth + noise, truth, 0.0) == pytest.approx(0.2, abs=3 / np.sqrt(400) / 5)


def test_a_cell_whose_truth_is_too_rough_is_not_counted(outcome):
    rough = dataclasses.replace(outcome.cells[0], truth_error=2.0)
    counted = dataclasses.replace(outcome, cells=[rough, *outcome.cells[1:]])
    assert len(counted.ratios) == len(outcome.cells) - 1
    assert "1 of 4 cells are not counted" in alpha_risk.findings(counted)[0]
    assert np.isfinite(counted.ratios).all()
