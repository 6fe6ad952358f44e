"""When a run stops, and that it says why."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mjxgrad as mg
from tests.estimators.test_nothing_felt import dead_zone
from tests.loop import problems
from tests.loop.problems import START, made_up


def test_a_log_is_told_the_last_step_of_every_segment(key):
    told = []
    settings = {"optimiser": optax.sgd(0.1), "num_steps": 60, "log": lambda *told_now: told.append(told_now)}
    result = mg.optimise(problems.objective, START, key, estimator=problems.exact, **settings)
    assert [step for step, _ in told] == list(range(3, 61, 3))
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
        log=lambda step, metrics: told.update({step: metrics}),
    )  # fmt: skip
    assert told[1]["cost"] == pytest.approx(result.history.cost[:, 0].mean())
    assert told[4]["cost"] == pytest.approx(result.history.cost[0, 3])


def test_a_run_that_feels_nothing_stops_at_once_and_says_so(key):
    """As a finger that does not reach the ball."""
    estimator = functools.partial(mg.estimators.alpha_order, num_samples=8)
    settings = {"estimator": estimator, "optimiser": optax.adam(0.1), "num_steps": 60}
    result = mg.optimise(mg.parameter_noise(dead_zone, 0.1), START, key, **settings)
    assert result.stopped == mg.Stopped.nothing_felt
    assert "nothing that the parameters change reaches the cost" in mg.Stopped[result.stopped]
    assert result.num_steps == 3
    np.testing.assert_array_equal(result.params, START)


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


def spoiled(objective, params, key):
    """NaN where the parameters are far."""
    estimate = problems.noisy(objective, params, key)
    gradient = jnp.where((params > 2).any(), jnp.nan, estimate.value)
    return made_up(gradient, cost=estimate.objective_mean, num_rollouts=4)


def test_one_seed_stops_without_the_others(key):
    """Three starts in one program; the last one is far off and is lost."""
    starts, settings = jnp.array([[0.0, 0.5], [0.9, -1.9], [3.0, 3.0]]), {"num_steps": 30, "patience": 3}
    together = mg.optimise(
        problems.objective, starts, jax.random.split(key, 3), estimator=spoiled, optimiser=optax.adam(0.05), **settings
    )
    assert list(together.num_steps) == [30, 30, 3]
    assert list(together.num_rollouts) == [120, 120, 12]
    assert list(together.stopped == mg.Stopped.not_finite) == [False, False, True]
    assert list(together.stopped == mg.Stopped.finished) == [True, True, False]
    assert np.isnan(together.history.cost[2, 3:]).all()
