"""When a run stops, and that it says why."""

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


def test_a_callback_sees_every_segment_and_can_stop(key):
    seen = []

    def callback(progress):
        seen.append((progress.step, progress.num_steps, progress.num_running, progress.history.cost.size))
        return progress.step >= 24

    result = run(key, callback=callback)
    assert seen == [(8, 60, 1, 8), (16, 60, 1, 16), (24, 60, 1, 24)]
    assert result.stopped == mg.Stopped.interrupted
    assert result.num_steps == 24


def test_a_callback_that_answers_nothing_lets_the_run_end(key):
    steps = []
    result = run(key, callback=lambda progress: steps.append(progress.step))
    assert steps == [8, 16, 24, 32, 40, 48, 56, 60]
    assert mg.Stopped[result.stopped] == "all steps were done"


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
