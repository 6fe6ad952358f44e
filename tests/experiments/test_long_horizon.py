"""The experiment on long horizons, on a linear motion, where growth, gradients and values are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from experiments.long_horizon import HELD, Problem, errors, last_crossing, scored, windowed

RATE = 3.0  # 1/s
MJCF = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"
stiffness="-9"/><geom size=".1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor joint="x"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def linear() -> Problem:
    """A mass on a spring that pushes away; the cost is −cos(x)."""
    scene = mg.load_scene(MJCF).with_engine("mujoco")
    return Problem("linear", scene, jnp.array([0.1, 0.0]), lambda x: -jnp.cos(x[0]), lambda x: x)


@pytest.fixture(scope="module")
def maps(linear) -> tuple[Any, Any]:
    return jax.jit(jax.jacfwd(linear.states, (0, 1)))(jnp.zeros((12, 1)), linear.start)


def test_derivatives_of_an_unstable_spring_grow_by_the_rate_of_its_equation(maps):
    """Euler's steps have the eigenvalues exp(±2 asinh(hλ/2)), which is e^{±λh} up to a share of h²λ²/24."""
    exact, time = 2 * np.arcsinh(0.01 * RATE / 2) / 0.01, 12 * HELD * 0.01
    assert exact == pytest.approx(RATE, rel=1e-4)
    assert np.abs(np.linalg.eigvals(maps[1][-1])).max() == pytest.approx(np.exp(exact * time), rel=1e-6)
    grown = np.log(np.linalg.norm(maps[1], ord=2, axis=(1, 2)))
    # What decays changes the norm by a share of e^{−2λt}, at 0.9 s 0.0045.
    assert (grown[-1] - grown[-4]) / (3 * HELD * 0.01) == pytest.approx(exact, rel=1e-2)


@pytest.fixture(scope="module")
def sampled(linear, maps) -> dict[str, Any]:
    """Rollouts of the linear motion, its exact gradients, and the derivatives of its exact value.

    E cos(x) = cos(E x) exp(−Var x / 2) for a normal x.
    """
    rng, stddev, horizon = np.random.default_rng(0), 2.0, 12
    noise = stddev * rng.normal(size=(4000, horizon, 1))
    by_control, by_start = (np.asarray(x) for x in maps)
    powers, pushes = by_start[:, 0], by_control[:, 0, 0, 0]  # of x at each time, by the start and by the first control
    states = np.asarray(jax.vmap(linear.states, (0, None))(noise, linear.start))
    spread = stddev**2 * np.concatenate([[0], np.cumsum(pushes**2)])
    felt = np.sin(powers @ np.asarray(linear.start)) * np.exp(-spread[1:] / 2)
    exact = felt[:, None, None] * by_control[:, 0, :, 0][:, :, None]
    charged = np.einsum("st,tk->tsk", np.sin(states[..., 0]), by_control[:, 0, :, 0])[..., None]
    ahead = np.zeros_like(charged)
    for t in range(horizon):
        slope = np.zeros((len(noise), 2))
        for later in range(horizon - t - 1):
            at = powers[later]
            slope += (np.sin(states[:, t] @ at) * np.exp(-spread[later + 1] / 2))[:, None] * at
        ahead[t] = np.einsum("si,iku->sku", slope, by_control[t])
    return {"noise": noise, "stddev": stddev, "states": states, "exact": exact, "charged": charged, "ahead": ahead}


def beyond_chance(samples: np.ndarray, exact: np.ndarray) -> float:
    error = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    return float((np.abs(samples.mean(axis=0) - exact) / np.maximum(error, 1e-12)).max())


def test_zeroth_and_first_order_have_the_gradient_of_each_horizon_and_of_the_mean_cost(sampled):
    costs, scores = -np.cos(sampled["states"][..., 0]), sampled["noise"] / sampled["stddev"] ** 2
    for time in (3, 11):
        assert beyond_chance(scored(costs, scores, time), sampled["exact"][time]) < 4
        assert beyond_chance(sampled["charged"][time], sampled["exact"][time]) < 4
    assert beyond_chance(scored(costs, scores, None), sampled["exact"].mean(axis=0)) < 4


@pytest.mark.parametrize("length", [1, 4, 5])
def test_windows_with_the_exact_value_are_unbiased_and_without_it_are_not(sampled, length):
    without, with_value = windowed(sampled["charged"], sampled["ahead"], length)
    exact = sampled["exact"].mean(axis=0)
    assert beyond_chance(with_value, exact) < 4
    assert beyond_chance(without, exact) > 10
    # What is as long as the horizon is the whole.
    assert np.allclose(windowed(sampled["charged"], sampled["ahead"], 12)[0], sampled["charged"].mean(axis=0))


def test_the_error_of_a_batch_is_its_bias_and_its_noise():
    """Samples of mean 1 and variance 4 about a truth of 0.5: 0.25 + 4/16."""
    rng = np.random.default_rng(1)
    samples, truth = 1 + 2 * rng.normal(size=(100_000, 1, 1)), 0.5 + rng.normal(size=(100_000, 1, 1))
    assert errors(samples, truth) == pytest.approx((0.5, 0.25), abs=0.02)


def test_an_exponential_crosses_a_constant_where_it_is_known():
    times = np.linspace(0.1, 3.0, 30)
    assert last_crossing(times, 2 * (times - 1.234)) == pytest.approx(1.234)
    assert last_crossing(times, -np.ones(30)) == np.inf
    assert last_crossing(times, np.ones(30)) == times[0]
