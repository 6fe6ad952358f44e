"""What a run does step by step, against closed forms and against the same steps taken by hand."""

import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from IPython.lib.pretty import pretty

import mjxgrad as mg
from mjxgrad import estimators
from tests.loop import problems
from tests.loop.problems import CENTRE, CURVATURE, START, STDDEV, made_up

SGD = optax.sgd(0.1)


def run(key, estimator=problems.exact, **settings):
    settings = {"optimiser": SGD, "num_steps": 30, **settings}
    return mg.optimise(problems.objective, START, key, estimator=estimator, **settings)


@pytest.fixture(scope="module")
def zeroth_order_run():
    return run(
        jax.random.key(3),
        problems.zeroth_order,
        optimiser=optax.adam(0.1),
        num_steps=250,
        evaluate=problems.bowl,
        evaluate_every=7,
    )


def test_a_run_ends_at_the_minimum(zeroth_order_run):
    # A step of Adam is about its learning rate, so it ends within a few of them.
    np.testing.assert_allclose(zeroth_order_run.params, CENTRE, atol=0.1)
    assert zeroth_order_run.final_cost < 0.01 < problems.bowl(START)
    assert zeroth_order_run.stopped == mg.Stopped.finished


def test_every_rollout_of_the_method_is_counted_and_none_of_the_measurement(zeroth_order_run):
    history = zeroth_order_run.history
    np.testing.assert_array_equal(history.num_rollouts, 16 * np.arange(1, 251))
    assert zeroth_order_run.num_rollouts == 16 * 250
    assert zeroth_order_run.num_gradient_rollouts == 0
    assert run(jax.random.key(0), problems.first_order).num_gradient_rollouts == 4 * 30


def test_the_noise_free_cost_is_measured_when_it_is_due(zeroth_order_run):
    is_measured = np.isfinite(zeroth_order_run.history.noise_free_cost)
    np.testing.assert_array_equal(np.flatnonzero(is_measured), np.arange(0, 250, 7))


def test_the_best_parameters_are_those_of_the_lowest_measured_cost(zeroth_order_run):
    measured = np.append(zeroth_order_run.history.noise_free_cost, zeroth_order_run.final_cost)
    assert zeroth_order_run.best_cost == np.nanmin(measured)
    assert problems.bowl(zeroth_order_run.best_params) == pytest.approx(float(zeroth_order_run.best_cost), rel=1e-12)


def test_seconds_grow_and_leave_out_compilation(zeroth_order_run):
    assert np.all(np.diff(zeroth_order_run.history.seconds) > 0)
    assert zeroth_order_run.seconds == pytest.approx(zeroth_order_run.history.seconds[-1])
    # 250 steps of 16 tiny rollouts take milliseconds, tracing and compiling them much longer.
    assert zeroth_order_run.seconds < zeroth_order_run.compile_seconds


def test_no_second_is_counted_twice(key):
    """An estimator that takes long to trace: counted twice, its time would exceed that of the whole."""

    def slow(objective, params, key):
        time.sleep(0.4)
        return problems.exact(objective, params, key)

    began = time.perf_counter()
    result = run(key, slow)
    assert result.compile_seconds > 0.4
    assert result.seconds + result.compile_seconds < time.perf_counter() - began


def test_the_mean_cost_under_noise_has_its_error_bar(zeroth_order_run):
    """Under noise the bowl is higher by σ²/2 of the trace of its curvature; judged at the start, which is known."""
    history = zeroth_order_run.history
    truth = problems.bowl(START) + STDDEV**2 / 2 * CURVATURE.sum()
    assert abs(history.cost[0] - truth) < 4 * history.cost_error[0]
    assert history.cost_error[0] < 0.1 * truth


def test_descent_on_a_quadratic_is_a_geometric_sequence(key):
    """The distance to the minimum shrinks by 1 - rate * curvature in each step."""
    result = run(key)
    np.testing.assert_allclose(result.params, CENTRE + (START - CENTRE) * (1 - 0.1 * CURVATURE) ** 30, rtol=1e-12)
    distance = (np.asarray(START - CENTRE)) * (1 - 0.1 * np.asarray(CURVATURE)) ** np.arange(30)[:, None]
    norms = np.linalg.norm(np.asarray(CURVATURE) * distance, axis=1)
    np.testing.assert_allclose(result.history.gradient_norm, norms, rtol=1e-10)
    np.testing.assert_allclose(result.history.step_norm, 0.1 * norms, rtol=1e-10)


def test_a_step_draws_its_noise_from_its_number(key):
    """The same steps by hand: first order on the bowl is the curvature times the mean of the noisy points."""
    x = np.asarray(START)
    for n in range(5):
        own = jax.random.fold_in(key, n)
        noise = [problems.objective.sample_noise(jax.random.fold_in(own, i)) for i in range(4)]
        x = x - 0.1 * np.asarray(CURVATURE) * (x + np.mean(noise, axis=0) - np.asarray(CENTRE))
    np.testing.assert_allclose(run(key, problems.first_order, num_steps=5).params, x, rtol=1e-12)


def test_a_step_that_is_not_finite_changes_nothing_but_its_count(key):
    """Every other estimate is NaN: Adam ends where it would have without those."""

    def every_other(objective, params, key):
        gradient = problems.exact(objective, params, key).value
        is_odd = jax.random.key_data(key).sum() % 2 == 1
        return made_up(jnp.where(is_odd, jnp.nan, gradient))

    with_gaps = run(key, every_other, optimiser=optax.adam(0.1), num_steps=40)
    is_taken = with_gaps.history.is_taken
    assert 5 < is_taken.sum() < 35
    assert with_gaps.num_skipped == (~is_taken).sum()
    without = run(key, optimiser=optax.adam(0.1), num_steps=int(is_taken.sum()))
    np.testing.assert_allclose(with_gaps.params, without.params, rtol=1e-12)
    np.testing.assert_array_equal(with_gaps.history.step_norm == 0, ~is_taken)


def test_a_result_is_shown_as_a_sentence(zeroth_order_run):
    """By `print`, and by IPython as a notebook does."""
    assert pretty(zeroth_order_run) == str(zeroth_order_run)
    assert repr(zeroth_order_run) == f"Optimisation({zeroth_order_run})"
    shapes = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, zeroth_order_run))
    assert "best_cost=" in repr(shapes), "shapes have no numbers"
    best, last = (float(x) for x in (zeroth_order_run.best_cost, zeroth_order_run.final_cost))
    costs = f"Best cost {best:.4g} (best_params), at the last step {last:.4g} (params)"
    assert f"{costs}, after 250 steps, 0 skipped: all steps were done" in str(zeroth_order_run)


WORSE = "last step is clearly worse than the best: take result.best_params."


@pytest.mark.parametrize(("error", "is_worse"), [(0.01, True), (100.0, False)])
def test_a_last_step_that_is_worse_beyond_its_error_is_said_first(key, error, is_worse):
    """Uphill on the bowl, from 9.875 to 77.55 = (1.1⁸ + 3 · 2.5² · 1.3⁸) / 2 before the fifth step."""

    def uphill(objective, params, key):
        return made_up(-CURVATURE * (params - CENTRE), cost=problems.bowl(params), cost_error=error)

    told = str(run(key, uphill, num_steps=5))
    assert (
        told.startswith(f"The {WORSE} Best mean cost under noise 9.875 (best_params), at the last step 77.55")
        == is_worse
    )
    assert (WORSE in told) == is_worse
    both = str(run(jax.random.split(key), uphill, num_steps=5))
    assert both.startswith(f"In 2 of 2 runs the {WORSE}") == is_worse
    assert f" ± {error:g} (params)" in told
    # Without noise there is no error, and under other noise nothing to compare.
    assert str(run(key, uphill, num_steps=5, evaluate=problems.bowl)).startswith(
        f"The {WORSE} Best cost 9.875 (best_params)"
    )
    annealed = mg.optimise(
        lambda scale: problems.objective,
        START,
        key,
        estimator=uphill,
        optimiser=SGD,
        num_steps=5,
        annealing=lambda step: 0.5**step,
    )
    assert WORSE not in str(annealed)


def test_a_last_step_that_is_worse_by_luck_is_no_worse(key):
    """Two hundred costs of nothing but noise: the lowest is some three errors below the last one."""

    def still(objective, params, key):
        return made_up(jnp.zeros(2), cost=1.0 + 0.1 * jax.random.normal(key), cost_error=0.1)

    found = run(jax.random.split(key, 20), still, num_steps=200)
    assert np.max(found.history.cost[:, -1] - found.best_cost) > 3 * np.hypot(0.1, 0.1)
    assert WORSE not in str(found)


@pytest.mark.parametrize("settings", [{"num_steps": 3}, {"patience": 4}])
def test_a_run_gives_up_after_steps_in_a_row_that_are_not_finite_and_never_says_that_all_were_done(key, settings):
    result = run(key, lambda *_: made_up([jnp.nan, 0.0]), **settings)
    assert result.stopped == mg.Stopped.not_finite
    assert [result.num_steps, result.num_skipped] == [*settings.values()] * 2
    np.testing.assert_array_equal(result.params, START)


def test_a_diverging_cost_never_reaches_the_parameters(key):
    """NaN beyond x₀ = 0.3: samples there are left out, and every estimate that remains is finite."""
    cost = mg.parameter_noise(lambda x: jnp.where(x[0] > 0.3, jnp.nan, problems.bowl(x)), STDDEV)
    result = mg.optimise(cost, START, key, estimator=problems.zeroth_order, optimiser=SGD, num_steps=60)
    assert np.isfinite(result.params).all()
    assert np.nanmin(result.history.finite_fraction) < 1
    assert np.isfinite(result.best_cost)


def test_the_best_has_no_advantage_from_samples_left_out(key):
    """Costs fall all the way, but only in the middle were all samples finite: the best is the last one there."""

    def spoiled(objective, params, key):
        estimate = problems.exact(objective, params, key)
        num_finite = jnp.where((params[0] > 0.2) & (params[0] < 0.5), 4, 3)
        return dataclasses.replace(estimate, num_samples=jnp.asarray(4), num_finite=num_finite)

    result = run(key, spoiled)
    full = result.history.finite_fraction == 1
    assert result.best_cost == result.history.cost[full].min() > result.history.cost.min()


def test_the_optimiser_is_told_the_cost(key):
    """reduce_on_plateau shortens the step as soon as what it is told no longer falls: here it falls all the way."""
    plateau = optax.chain(optax.sgd(1.0), optax.contrib.reduce_on_plateau(factor=0.5, patience=1))
    falling = run(
        key, lambda objective, params, key: made_up([1.0, 0.0], cost=params[0]), optimiser=plateau, num_steps=6
    )
    np.testing.assert_allclose(falling.history.step_norm, 1.0)


def test_a_run_of_the_same_program_compiles_nothing_and_what_functions_read_is_read_again(key, compilations):
    """Everything is made anew: the cost, its noise, the estimator and the optimiser. A target that has changed counts."""
    target = {"place": 1.0}

    def again(start):
        objective = mg.parameter_noise(lambda x: jnp.sum((x - target["place"]) ** 2), stddev=0.1)
        estimator = functools.partial(mg.estimators.first_order, num_samples=4)
        settings = {"estimator": estimator, "optimiser": optax.sgd(0.2), "num_steps": 40}
        return mg.optimise(objective, start, key, **settings).params

    again(jnp.array([0.0]))
    before = len(compilations)
    np.testing.assert_allclose(again(jnp.array([0.5])), 1.0, atol=0.2)
    assert len(compilations) == before
    target["place"] = 3.0
    np.testing.assert_allclose(again(jnp.array([0.5])), 3.0, atol=0.2)


def test_a_schedule_of_noise_is_followed(key):
    """E[bowl] exceeds bowl by scale² σ²/2 tr C, so the recorded cost tells the noise that was used."""
    schedule = optax.exponential_decay(1.0, 1, 0.5)
    result = mg.optimise(
        lambda scale: problems.objective.with_stddev(0.3 * scale),
        problems.CENTRE,
        key,
        estimator=functools.partial(estimators.zeroth_order, num_samples=4096),
        optimiser=optax.sgd(0.0),
        num_steps=4,
        annealing=schedule,
    )
    history, expected = result.history, 0.5 ** np.arange(4)
    np.testing.assert_allclose(history.scale, expected, rtol=1e-6)
    truth = (0.3 * expected) ** 2 / 2 * float(problems.CURVATURE.sum())
    assert np.all(np.abs(history.cost - truth) < 4 * history.cost_error)
    assert np.all(history.cost_error < 0.1 * truth)


def test_the_best_is_sought_where_smoothing_was_least(key):
    """The cost at much noise is made lower than ever after: it must not win."""

    def estimator(objective, params, key):
        return made_up(jnp.ones(2), cost=jnp.where(objective.stddev > 0.7, -5.0, params.sum()))

    result = mg.optimise(
        lambda scale: problems.objective.with_stddev(scale),
        jnp.zeros(2),
        key,
        estimator=estimator,
        optimiser=optax.sgd(0.1),
        num_steps=6,
        annealing=lambda step: jnp.where(step < 3, 1.0, 0.5),
    )
    np.testing.assert_allclose(result.best_params, -0.5)
    np.testing.assert_allclose(result.best_cost, -1.0)
