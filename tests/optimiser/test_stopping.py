"""When a run stops, and that it says why."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from tests.optimiser import problems
from tests.optimiser.problems import made_up

START = jnp.array([0.0, 0.5])


def run(key, estimator=problems.exact, **settings):
    settings = {"optimiser": optax.sgd(0.1), "num_steps": 60, "segment": 8, **settings}
    return mg.optimise(problems.objective, START, key, estimator=estimator, **settings)


def test_a_budget_of_rollouts_is_kept(key):
    """Seven rollouts a step: 100 of them are 14 steps, and 98 are 14 steps to the last rollout."""
    for budget in (98, 100):
        result = run(key, lambda *_: made_up([1.0, 0.0], num_rollouts=7), max_rollouts=budget)
        assert result.stopped == mg.Stopped.max_rollouts
        assert result.num_rollouts == 98
        assert result.history.cost.shape == (14,)


def test_a_budget_of_seconds_is_looked_at_between_segments(key):
    result = run(key, max_seconds=1e-9)
    assert result.stopped == mg.Stopped.max_seconds
    assert result.num_steps == 8


def test_many_seeds_share_the_budget_of_seconds(key):
    result = run(jax.random.split(key, 2), max_seconds=1e-9)
    assert list(result.stopped == mg.Stopped.max_seconds) == [True, True]


def test_a_log_is_told_the_last_step_of_every_segment(key):
    told = []
    result = run(key, log=lambda step, metrics: told.append((step, metrics)))
    assert [step for step, _ in told] == [8, 16, 24, 32, 40, 48, 56, 60]
    assert mg.Stopped[result.stopped] == "all steps were done"
    for step, metrics in told:
        for name in ("cost", "gradient_norm", "alpha", "step_norm", "num_rollouts", "seconds"):
            assert metrics[name] == getattr(result.history, name)[step - 1]
    assert told[-1][1]["best_cost"] == result.best_cost
    assert np.isnan(metrics["noise_free_cost"])
    assert {type(x) for x in metrics.values()} == {float}


def test_a_log_of_many_seeds_has_the_mean_of_those_that_took_the_step(key):
    """The second seed is given up at its third step."""
    told, starts = {}, jnp.array([[0.0, 0.5], [3.0, 3.0]])
    keys = jax.random.split(key, 2)
    result = mg.optimise(
        problems.objective, starts, keys, estimator=spoiled, optimiser=optax.sgd(0.1), num_steps=4, patience=3,
        segment=1, log=lambda step, metrics: told.update({step: metrics}),
    )  # fmt: skip
    assert told[1]["cost"] == pytest.approx(result.history.cost[:, 0].mean())
    assert told[4]["cost"] == pytest.approx(result.history.cost[0, 3])


def dead_zone(x):
    """Nothing within 1 of zero, then a slope: a finger that does not reach the ball."""
    return 5.0 + jnp.maximum(jnp.abs(x) - 1, 0.0).sum()


@pytest.mark.parametrize("name", ["first_order", "zeroth_order", "alpha_order", "control_variate"])
@pytest.mark.parametrize("convergence", [None, mg.Convergence(window=2, gradient=1.0, cost=0.0)])
def test_a_run_that_feels_nothing_stops_at_once_and_says_so(key, name, convergence):
    """A gradient of zero without an error is what convergence looks for, so it must not be asked."""
    result = mg.optimise(
        mg.parameter_noise(dead_zone, 0.1),
        START,
        key,
        estimator=functools.partial(getattr(mg.estimators, name), num_samples=8),
        optimiser=optax.adam(0.1),
        num_steps=60,
        convergence=convergence,
    )
    assert result.stopped == mg.Stopped.nothing_felt
    assert "nothing that the parameters change reaches the cost" in mg.Stopped[result.stopped]
    assert result.num_steps == 3
    np.testing.assert_array_equal(result.params, START)


def test_one_seed_that_feels_nothing_stops_without_the_others(key):
    starts = jnp.array([[0.0, 0.5], [2.0, 2.0]])
    result = mg.optimise(
        mg.parameter_noise(dead_zone, 0.1), starts, jax.random.split(key, 2),
        estimator=problems.first_order, optimiser=optax.sgd(0.01), num_steps=10,
    )  # fmt: skip
    assert list(result.stopped == mg.Stopped.nothing_felt) == [True, False]
    assert list(result.num_steps) == [3, 10]


def test_momentum_has_the_patience_of_the_run_to_leave_a_zone_where_nothing_is_felt(key):
    """Nothing is felt from 1 to 1.3, where momentum crosses: 0.5, then 0.45, 0.405 ... a step of 0.1."""

    def cost(x):
        return jnp.where((x[0] > 1.0) & (x[0] < 1.3), 2.0, -x[0])

    settings = {"estimator": problems.first_order, "optimiser": optax.sgd(0.01, momentum=0.9), "num_steps": 60}
    objective = mg.parameter_noise(cost, 1e-3, dim=1)
    crossing = mg.optimise(objective, jnp.array([0.5]), key, **settings)
    assert crossing.stopped == mg.Stopped.finished
    assert crossing.params[0] > 1.3
    lost = mg.optimise(mg.parameter_noise(dead_zone, 1e-3), jnp.array([1.005]), key, **settings)
    assert lost.stopped == mg.Stopped.nothing_felt
    assert 10 <= lost.num_steps < 20


def test_a_cost_that_stands_still_is_convergence(key):
    """The cost falls by 1 a step for 20 steps, then no more; two windows of 5 fit on the flat after 30."""

    def estimator(objective, params, key):
        return made_up([1.0, 0.0], cost=jnp.maximum(20 + 10 * params[0], 0.0))

    result = run(key, estimator, convergence=mg.Convergence(window=5, cost=0.0))
    assert result.stopped == mg.Stopped.converged
    assert result.num_steps == 30


@pytest.mark.parametrize(("norm", "is_over"), [(1.05, True), (1.2, False)])
def test_a_gradient_lost_in_its_error_is_convergence(key, norm, is_over):
    """‖e‖ = 1: what is left of ‖g‖² is 0.1025 or 0.44, against 0.5² = 0.25."""
    error = 1 / np.sqrt(2)
    result = run(key, lambda *_: made_up([norm, 0.0], error=error), convergence=mg.Convergence(window=5, gradient=0.5))
    assert (result.stopped == mg.Stopped.converged) == is_over
    assert result.num_steps == (5 if is_over else 60)


def test_convergence_waits_until_annealing_stands_still(key):
    """The scale changes at step 12, so the windows begin anew: 2 * 5 steps later the cost is judged."""
    result = mg.optimise(
        problems.objective.with_stddev,
        START,
        key,
        estimator=lambda *_: made_up([1.0, 0.0], cost=1.0),
        optimiser=optax.sgd(0.1),
        num_steps=60,
        annealing=lambda step: jnp.where(step < 12, 1.0 / (step + 1), 0.01),
        convergence=mg.Convergence(window=5, cost=0.0),
    )
    assert result.num_steps == 22


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({}, "Convergence must be given gradient, cost or both"),
        ({"window": 1, "cost": 0.1}, "window must be at least 2, got 1"),
        ({"gradient": -1.0}, "gradient must be at least 0, got -1.0"),
    ],
)
def test_convergence_without_meaning_is_refused(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        mg.Convergence(**settings)


@pytest.fixture(scope="module")
def seeds():
    """Three starts and keys in one program; a run that starts far off spends its budget of trust: it is lost."""
    keys = jax.random.split(jax.random.key(11), 3)
    starts = jnp.array([[0.0, 0.5], [0.9, -1.9], [3.0, 3.0]])
    settings = {
        "estimator": spoiled,
        "optimiser": optax.adam(0.05),
        "num_steps": 30,
        "evaluate": problems.bowl,
        "patience": 3,
    }
    together = mg.optimise(problems.objective, starts, keys, **settings)
    alone = [mg.optimise(problems.objective, s, k, **settings) for s, k in zip(starts, keys, strict=True)]
    return together, alone


def spoiled(objective, params, key):
    """NaN where the parameters are far."""
    estimate = problems.noisy(objective, params, key)
    gradient = jnp.where((params > 2).any(), jnp.nan, estimate.value)
    return made_up(gradient, cost=estimate.objective_mean, num_rollouts=4)


def test_many_seeds_are_as_many_runs(seeds):
    together, alone = seeds
    for i, single in enumerate(alone):
        # Rounding apart: a batch may be summed in another order.
        np.testing.assert_allclose(together.params[i], single.params, rtol=1e-12)
        np.testing.assert_allclose(together.best_params[i], single.best_params, rtol=1e-12)
        length = single.history.cost.size
        np.testing.assert_allclose(together.history.cost[i][:length], single.history.cost, rtol=1e-10)
        np.testing.assert_array_equal(
            np.isnan(together.history.noise_free_cost[i][:length]), np.isnan(single.history.noise_free_cost)
        )


def test_one_seed_stops_without_the_others(seeds):
    together, _ = seeds
    assert list(together.num_steps) == [30, 30, 3]
    assert list(together.num_rollouts) == [120, 120, 12]
    assert list(together.stopped == mg.Stopped.not_finite) == [False, False, True]
    assert list(together.stopped == mg.Stopped.finished) == [True, True, False]
    assert np.isnan(together.history.cost[2, 3:]).all()


def test_seeds_draw_different_noise(key):
    result = mg.optimise(
        problems.objective,
        START,
        jax.random.split(key, 3),
        estimator=problems.noisy,
        optimiser=optax.sgd(0.1),
        num_steps=2,
    )
    assert len(np.unique(result.params[:, 0])) == 3
