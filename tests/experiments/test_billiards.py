"""The stroke against hard balls, whose motion is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.billiards import (
    MethodSettings,
    Outcome,
    Run,
    Settings,
    answer,
    billiards,
    hard_cost,
    hard_optimum,
    verdict,
)


@pytest.fixture(scope="module")
def task():
    return billiards(num_pieces=10)


@pytest.fixture(scope="module")
def differentiated(task):
    return jax.jit(jax.value_and_grad(task.cost))


def best_forces(num_pieces):
    """The best force is linear in time up to the collision; here its mean over each piece."""
    _, end, speed = hard_optimum()
    gap = np.sqrt(2) - 0.4
    edges = np.minimum(np.arange(num_pieces + 1) / num_pieces, end)
    first, slope = 6 * gap / end**2 - 2 * speed / end, 6 * speed / end**2 - 12 * gap / end**3
    along = np.diff(first * edges + slope * edges**2 / 2) * num_pieces
    return np.repeat(along[:, None], 2, axis=1) / np.sqrt(2)


def test_the_optimum_for_hard_balls_is_the_published_one():
    assert hard_optimum()[0] == pytest.approx(1.396542, abs=1e-6)


def test_the_best_force_played_on_hard_balls_costs_the_optimum():
    # In pieces of 1 ms the force is right but for the piece in which the balls meet: 1e-3 of the time.
    assert hard_cost(best_forces(1000)) == pytest.approx(hard_optimum()[0], abs=2e-3)


@pytest.mark.slow
def test_the_simulated_stroke_costs_what_hard_balls_say(task, differentiated):
    for forces in (best_forces(10), np.tile([3.2, 2.9], (10, 1))):
        simulated, _ = differentiated(jnp.asarray(forces.ravel()))
        # The contact takes 11 ms of a second and begins 27 mm early.
        assert float(simulated) == pytest.approx(hard_cost(forces), abs=0.03)


@pytest.mark.slow
def test_as_long_as_the_balls_do_not_touch_the_derivative_is_that_of_the_effort(task, differentiated):
    start = task.start(1.3)
    cost, gradient = differentiated(start)
    assert float(cost) == pytest.approx(2 + 0.1 * 2 * 1.3**2, rel=1e-12)
    assert np.allclose(gradient, 2 * 0.1 * start / 10, rtol=1e-9)


def test_a_contact_that_begins_earlier_lets_the_derivative_see_the_other_ball(task):
    start = task.start(1.3)
    gradient = jax.jit(jax.grad(lambda params, margin: task.with_margin(margin).cost(params)))(start, 0.3)
    effort = 2 * 0.1 * start / 10
    # Pushing harder at first brings the other ball closer to the target, which is worth more than the effort.
    assert np.all(np.asarray(gradient - effort)[:4] < -0.01)


def run_of(label, cost, *, touches=False):
    return Run(
        method=MethodSettings(label=label), steps=np.array([0, 80]), cost=np.array([2.3, cost]), final_cost=cost,
        hard_cost=cost + 0.005, qpos=np.zeros((3, 4)), touches_at_start=touches,
        num_rollouts=160, seconds=1.0, compile_seconds=1.0,
    )  # fmt: skip


def test_the_verdict_tells_solved_from_stuck():
    runs = (run_of("near", 1.395), run_of("idle", 1.9999), run_of("half", 1.7), run_of("touching", 1.39, touches=True))
    settings = Settings(experiment="billiards", methods=tuple(run.method for run in runs))
    text = verdict(Outcome(settings, runs))
    assert answer(Outcome(settings, runs)) == "1 of 3 find it to 1%: “near”."
    assert "“near” (1.395) reach the optimum of 1.3965" in text
    assert "No progress beyond standing still (cost 2): “idle” (2.000); in between: “half” (1.700)." in text
    assert "“touching”: solved (1.390)" in text
