"""The report on policy gradients, from numbers with known answers; and a whole run, which takes minutes."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.__main__ import main
from experiments.policy_gradient import (
    Cell,
    Estimated,
    Outcome,
    Settings,
    answer,
    drawings,
    estimated,
    jackknife_error,
    share_along,
    squared_distance,
    squared_norm,
    tables,
    verdict,
)
from experiments.theme import save

SETTINGS = Settings(
    experiment="policy_gradient", tasks=("hopper",), angles=(0.4,), angle_stddev=0.05, num_estimates=8, num_references=8,
)  # fmt: skip
INCONSISTENT, TRUSTED = 4, 1  # items of mg.estimators.Reason


def around(mean, spread=0.01, count=16):
    """Estimates with the given mean exactly, so that only what was put in is found."""
    noise = np.random.default_rng(3).normal(scale=spread, size=(count, len(mean)))
    return np.asarray(mean) + noise - noise.mean(axis=0)


def cell(discrete, onset, *, name="hopper", point="start", hits_and_misses=False):
    """A task of gradient (3, 4), of norm 5, and first-order means that differ from it by what is given."""
    truth = np.array([3.0, 4.0])

    def estimates(error, alpha, reason):
        first, unbiased = around(truth + error, 1e-4), around(truth, 0.5)
        return Estimated(first, unbiased, np.full(16, alpha), np.full(16, reason), np.zeros(16))

    both = {"discrete": estimates(discrete, 0.0, INCONSISTENT), "onset": estimates(onset, 0.8, TRUSTED)}
    return Cell(name, "Task", point, hits_and_misses, True, both, around(truth))


def outcome(*cells):
    return Outcome(SETTINGS, list(cells))


def test_a_squared_norm_leaves_out_the_product_of_an_estimate_with_itself():
    """(1, 2)·(3, 4) = 11, once in either order."""
    assert squared_norm(np.array([[1.0, 2.0], [3.0, 4.0]])) == pytest.approx(11, rel=1e-14)


def test_the_distance_of_independent_estimates_is_that_of_their_means():
    """Of vectors without noise: (3, 4) and (3, 2) are 2 apart, of 5, the first has 17/25 along the first."""
    first, reference = np.tile([3.0, 2.0], (8, 1)), np.tile([3.0, 4.0], (8, 1))
    assert squared_distance(first, reference) == pytest.approx(4 / 25, rel=1e-12)
    assert share_along(first, reference) == pytest.approx(17 / 25, rel=1e-12)


def test_the_jackknife_of_a_difference_of_means_is_its_standard_error():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(10, 1)), rng.normal(scale=3, size=(20, 1))
    exact = np.sqrt(a.var(ddof=1) / 10 + b.var(ddof=1) / 20)
    assert jackknife_error(lambda x, y: float(x.mean() - y.mean()), a, b) == pytest.approx(exact, rel=1e-12)


def test_one_program_gives_what_the_public_estimators_give(key):
    objective = mg.parameter_noise(lambda x: jnp.sin(3 * x[0]) + x[0] * x[1] ** 2, 0.3)
    at, both = jnp.array([0.2, 0.7]), {"params": jnp.array([0.2, 0.7]), "key": key, "num_samples": 20}
    found = estimated(objective, at, key, 20)
    chosen = mg.estimators.alpha_order(objective, **both)
    first = mg.estimators.alpha_order(objective, **both, rule=mg.estimators.rules.FixedAlpha(1.0))
    unbiased = mg.estimators.control_variate(objective, **both)
    assert np.allclose(found.first, first.value, rtol=1e-12)
    assert np.allclose(found.unbiased, unbiased.value, rtol=1e-12)
    assert np.allclose(found.alpha * found.first + (1 - found.alpha) * found.unbiased, chosen.value, rtol=1e-12)
    assert 0 < chosen.alpha < 1  # else the mixture is one of its parts
    assert float(found.alpha) == pytest.approx(float(chosen.alpha), rel=1e-12)


def test_a_bias_is_measured_by_the_norm_of_the_gradient():
    """3 of 5 is 60 %, to what the noise of 0.01 leaves open."""
    bias, low, high = cell([3.0, 0.0], [0.0, 0.0]).judged["discrete"][:3]
    assert bias == pytest.approx(0.6, abs=2e-3)
    assert low < bias < high
    assert high - low < 0.02
    assert cell([3.0, 0.0], [0.0, 0.0]).judged["onset"].low == 0


def test_a_gradient_lost_in_its_noise_judges_nothing():
    """The mean of these is zero, so that its squared norm, noise taken off, is below zero."""
    lost = dataclasses.replace(cell([3.0, 0.0], [0.0, 0.0]), reference=around([0.0, 0.0], 1.0))
    assert np.isnan(lost.norm)
    assert np.isnan(lost.judged["discrete"].bias)
    assert "biased" not in verdict(outcome(lost))
    assert len(tables(outcome(lost))[0].rows) == 2


@pytest.mark.parametrize(
    ("cells", "words", "said"),
    [
        (
            [cell([3.0, 0.0], [0.0, 0.0]), cell([0.0, 0.0], [0.0, 0.0])],
            "biased at 1 of 2 points without a jump",
            "from 1 to 0 of 2",
        ),
        ([cell([0.0, 0.0], [3.0, 0.0], point="0.5 rad")], "is worse in Task, 0.5 rad", "does not help"),
        (
            [cell([3.0, 0.0], [2.5, 0.0], hits_and_misses=True)],
            "biased by 50%, and α-order gives it a weight of 0.80",
            "biased at 1 of 1",
        ),
    ],
)
def test_the_verdict_says_where_an_onset_repairs_where_it_harms_and_what_it_does_not_see(cells, words, said):
    assert words in verdict(outcome(*cells))
    assert said in answer(outcome(*cells))


def test_the_table_tells_what_alpha_order_makes_of_both():
    """A weight of 0 leaves all of the unbiased part's error, one of 0.8 a fifth; the first order has almost none."""
    one = outcome(cell([3.0, 0.0], [0.0, 0.0]))
    discrete, onset = (one.cells[0].judged[gradient].error_mixed for gradient in ("discrete", "onset"))
    assert discrete == pytest.approx(5 * onset, rel=0.01)
    (table,) = tables(one)
    assert table.emphasised == {(0, 3)}
    assert [row[5][:4] for row in table.rows] == ["0.00", "0.80"]
    assert [row[6] for row in table.rows] == ["contradictory 100%", "trusted 100%"]


def test_every_task_gets_its_figure(tmp_path):
    throws = [cell([3.0, 0.0], [0.0, 0.0], name="ball_wall", point=f"{angle} rad") for angle in (0.4, 0.5)]
    one = outcome(*throws, cell([3.0, 0.0], [0.0, 0.0]))
    figures = save(drawings(one), one, tmp_path)
    assert [figure.file for figure in figures] == [f"figures/{name}.svg" for name in ("summary", "throw")]
    assert len(one.rows()) == 2 * 3


@pytest.mark.slow
def test_a_throw_under_default_contact_is_compared_from_file_to_report(tmp_path):
    """After the bounce on the floor the discrete gradient is many times too large; no throw at 0.8 rad meets the wall."""
    command = ["run", "policy_gradient", 'tasks=["ball_wall_default"]', "angles=[0.8]", "num_estimates=16"]
    command += ["num_references=16", "--output", str(tmp_path)]
    assert main(command) == 0
    sentence = json.loads((tmp_path / "policy_gradient" / "summary.json").read_text())["verdict"]
    assert "The discrete first-order gradient is biased at 1 of 1 points" in sentence
    assert "Nowhere is contact that begins within the step the worse" in sentence
