"""Windows: what they return, both of its gradients, and how these are mixed."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_discrete_lyapunov

import mjxgrad as mg
from mjxgrad import envs
from mjxgrad.learning import learner
from mjxgrad.learning.networks import Network, Normaliser
from mjxgrad.learning.window import Gradients, Window, _faded, lambda_returns, returned, run_window, window_gradients

STEPS, STDDEV, DISCOUNT = 3, 0.3, 0.9  # of the windows that are run
COUNT = 8192  # of which means are taken, each with its opposite noise


def window_of(rewards, terminated=(), truncated=()):
    """A window whose next observations are 10, 20, ...: the value function below gives them back."""
    count = len(rewards)
    at = np.arange(count)
    column = 10.0 * (at + 1)[:, None]
    flags = [jnp.asarray(np.isin(at, steps)) for steps in (terminated, truncated)]
    return Window(jnp.asarray(column - 10), jnp.asarray(column), jnp.asarray(rewards, float), *flags, {})


def first_number(obs):
    return obs[0]


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        ({}, 1 + 0.9 * 2 + 0.81 * 3 + 0.729 * 30),
        ({"terminated": [0]}, 1 + (2 + 0.9 * 3 + 0.81 * 30)),
        ({"truncated": [0]}, (1 + 0.9 * 10) + (2 + 0.9 * 3 + 0.81 * 30)),
    ],
)
def test_a_window_returns_discounted_rewards_and_the_value_of_where_it_ends(ends, expected):
    """An end for good has no value, an end of time that of its last observation; what follows counts anew."""
    assert_allclose(returned(window_of([1, 2, 3], **ends), first_number, 0.9), expected)


def test_targets_mix_sums_of_all_lengths():
    """G_t = Σ_n (1 − λ)λ^{n−1} G_t^{(n)}, the last sum with weight λ^{n−1}; Sutton and Barto, equation 12.18."""
    rewards, values, discount, trace = [1.0, 2.0, 3.0], [10.0, 20.0, 30.0], 0.9, 0.7
    sums = [sum(discount**k * rewards[k] for k in range(n)) + discount**n * values[n - 1] for n in (1, 2, 3)]
    expected = (1 - trace) * sums[0] + (1 - trace) * trace * sums[1] + trace**2 * sums[2]
    assert_allclose(lambda_returns(window_of(rewards), first_number, discount, trace)[0], expected)


def test_targets_do_not_look_across_an_end():
    found = lambda_returns(window_of([1, 2, 3], terminated=[1]), first_number, 0.9, 1.0)
    assert_allclose(found, [1 + 0.9 * 2, 2, 3 + 0.9 * 30])


def test_episodes_are_added_up_across_windows():
    """Two environments; the first ends after its second step, having returned 5 before."""
    windows = jax.tree.map(lambda x, y: jnp.stack([x, y]), window_of([1, 2, 3], terminated=[1]), window_of([1, 1, 1]))
    so_far, found = learner._episodes(windows, jnp.array([5.0, 7.0]))
    assert_allclose(so_far, [3, 10])
    assert_allclose(found["return"], 5 + 1 + 2)


class SlowEyed(envs.diffrl.CartPole):
    """The swing-up by a policy that sees no speeds; they are privileged."""

    def observe(self, state, memory):
        return super().observe(state, memory)[jnp.array([0, 2, 3])]

    def privileged(self, state, memory):
        return state.qvel


@pytest.fixture(scope="module")
def cartpole():
    plain = envs.load("diffrl_cartpole")
    return SlowEyed(plain.scene, frame_skip=plain.frame_skip, episode_length=plain.episode_length)


@pytest.fixture(scope="module")
def networks():
    """Values large and curved enough that their part of the derivative is seen."""
    actor_key, critic_key = jax.random.split(jax.random.key(3))
    actor = Network.make((3, 6, 1), actor_key, final_scale=0.01)
    actor = eqx.tree_at(lambda a: a.layers[-1].weight, actor, 50 * actor.layers[-1].weight)
    critic = Network.make((5, 6, 1), critic_key, final_scale=5.0)
    return (
        actor,
        lambda seen: critic(seen)[0],
        Normaliser.make(5).with_more(jax.random.normal(jax.random.key(4), (20, 5))),
    )


@pytest.fixture(scope="module")
def gradients_at(cartpole, networks):
    """From a start and noise to windows and gradients, for a batch."""
    actor, critic, normaliser = networks

    @functools.partial(jax.jit, static_argnames="trace")
    def run(states, noise, trace=1.0):
        keys = jax.random.split(jax.random.key(0), len(noise))
        one = functools.partial(
            window_gradients,
            cartpole,
            actor=actor,
            critic=critic,
            normaliser=normaliser,
            stddev=jnp.asarray(STDDEV),
            discount=DISCOUNT,
            trace=trace,
        )
        return jax.vmap(one)(states, keys, noise)

    return run


def test_the_first_order_gradient_is_the_slope_of_each_step_s_lambda_return(cartpole, networks, gradients_at, key):
    """Later actions follow by the policy; the motion is that of a trace of 1.

    Central differences of 1e-5 are off by their square times a third derivative of some hundred: 1e-8.
    """
    actor, critic, normaliser = networks
    start, trace = cartpole.reset(key), 0.6
    noise = jnp.array([[0.4], [-1.2], [0.7]])
    states = jax.tree.map(lambda x: x[None], start)
    window, _, found = gradients_at(states, noise[None], trace=trace)
    assert_allclose(window.seen[0, 0], jnp.concatenate([start.obs, start.physics.qvel]))
    assert jnp.all(window.next_seen[0, :, 3:] != 0)

    @jax.jit
    def targets(added):
        window, _ = run_window(cartpole, start, actor, normaliser, added)
        return lambda_returns(window, lambda obs: critic(normaliser(obs)), DISCOUNT, trace), window.seen

    assert_allclose(window.seen[0], targets(STDDEV * noise)[1], rtol=1e-12, atol=1e-12)
    for t in range(STEPS):
        change = jnp.zeros_like(noise).at[t].set(1e-5)
        slope = (targets(STDDEV * noise + change)[0] - targets(STDDEV * noise - change)[0])[t] / 2e-5
        assert_allclose(found.first[0, t, 0], DISCOUNT**t * slope, rtol=1e-6)


def test_what_is_infinite_in_a_state_stays_so():
    """A memory may hold infinity, such as a best value so far."""
    state = {"best": jnp.array([1.0, -jnp.inf])}
    found, change = jax.jvp(lambda state: _faded(state, 0.6), (state,), (jax.tree.map(jnp.ones_like, state),))
    assert_array_equal(found["best"], state["best"])
    assert_allclose(change["best"][0], 0.6)


class Spring(envs.Environment):
    """A mass on a spring, whose reward is quadratic."""

    scene: mg.Scene

    def observe(self, state, memory):
        return jnp.concatenate([state.qpos, state.qvel])

    def rewards(self, before, action, after, memory):
        return {"cost": -(after.qpos**2).sum() - (after.qvel**2).sum()}


class Quadratic(Network):
    """The function -xᵀPx."""

    P: jax.Array

    def __call__(self, inputs):
        return -(inputs @ self.P @ inputs)[None]


def test_with_the_exact_value_function_the_trace_changes_no_mean():
    """Under a policy that is zero the motion is linear, and the value is -xᵀPx, P = Σ (γAᵀA)ᵏ by the Lyapunov equation.

    With a value four times as large it does, and zeroth order has the changed mean, too.
    """
    scene = mg.load_scene("""<mujoco><option gravity="0 0 0" timestep=".1"/><worldbody><body><joint name="x" type="slide"
        axis="1 0 0" stiffness="3" damping="1"/><geom size=".1" mass="1"/></body></worldbody>
        <actuator><motor joint="x" gear="5" ctrlrange="-1 1"/></actuator></mujoco>""")
    environment = Spring(scene)
    A = np.asarray(jax.jit(lambda: mg.linearise(scene, mg.initial_state(scene), jnp.zeros(1)).A)())
    P = solve_discrete_lyapunov(np.sqrt(DISCOUNT) * A.T, A.T @ A)
    noise = jax.random.normal(jax.random.key(1), (8192, STEPS, 1))

    @functools.partial(jax.jit, static_argnames="trace")
    def gradients(P, trace):
        def one(noise):
            state = environment.reset(jax.random.key(0))
            state = dataclasses.replace(state, physics=mg.initial_state(scene, jnp.array([0.5]), jnp.array([1.0])))
            state = dataclasses.replace(state, obs=environment.observe(state.physics, None))
            networks = (
                Quadratic((), (), jnp.zeros((2, 2))),
                lambda obs: Quadratic((), (), P)(obs)[0],
                Normaliser.make(2),
            )
            return window_gradients(
                environment, state, jax.random.key(0), noise, *networks, jnp.asarray(STDDEV), DISCOUNT, trace
            )[2]

        found = jax.vmap(one)(jnp.concatenate([noise, -noise]))
        return jax.tree.map(lambda x: x.reshape(2, len(noise), -1).mean(axis=0), found)  # of opposite noise

    def off(difference):
        return np.abs(difference.mean(axis=0)) / (difference.std(axis=0) / len(difference) ** 0.5 + 1e-12)

    assert np.all(off(gradients(P, 0.5).first - gradients(P, 1.0).first) < 4)
    wrong = gradients(4 * P, 0.5)
    assert np.all(off(wrong.first - gradients(4 * P, 1.0).first)[:-1] > 6)
    assert np.all(off(wrong.zeroth - wrong.first) < 4)
    assert off(wrong.zeroth - gradients(4 * P, 1.0).first)[0] > 6


def test_pulled_back_it_is_the_derivative_by_the_parameters(cartpole, networks, gradients_at, key):
    """Through physics and policy at once, by plain differentiation."""
    actor, critic, normaliser = networks
    start = cartpole.reset(key)
    noise = jnp.array([[0.4], [-1.2], [0.7]])
    # As many as where means are compared, all alike, so that it is the same program.
    states, every = jax.tree.map(lambda x: jnp.broadcast_to(x, (2 * COUNT, *x.shape)), (start, noise))
    window, _, found = gradients_at(states, every)

    def gain(actor):
        ran, _ = run_window(cartpole, start, actor, normaliser, STDDEV * noise)
        return returned(ran, lambda obs: critic(normaliser(obs)), DISCOUNT)

    whole = jax.jit(jax.grad(gain))(actor)

    @jax.jit
    def pull_back(actor, seen, cotangent):
        return jax.vjp(lambda a: jax.vmap(lambda seen: a(normaliser(seen)[:3]))(seen), actor)[1](cotangent)

    (pulled,) = pull_back(actor, window.seen[0], found.first[0])
    jax.tree.map(lambda x, y: assert_allclose(x, y, rtol=1e-9, atol=1e-12), pulled, whole)


def test_both_gradients_have_the_same_mean(cartpole, gradients_at, key):
    """Nothing jumps, so both are unbiased for the smoothed return; opposite noise takes out what the values have wrong."""
    start = cartpole.reset(key)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (2 * COUNT, *x.shape)), start)
    noise = jax.random.normal(jax.random.key(5), (COUNT, STEPS, 1))
    _, _, found = gradients_at(states, jnp.concatenate([noise, -noise]))
    difference = (found.zeroth - found.first)[..., 0].reshape(2, COUNT, STEPS).mean(axis=0)
    error = difference.std(axis=0) / COUNT**0.5
    assert np.all(np.abs(difference.mean(axis=0)) < 4 * error)
    # A missing discount, a tenth or more from the second step on, is seen.
    assert np.all((error < 0.025 * np.abs(found.first[..., 0].mean(axis=0)))[1:])


def random_gradients(*, bad=()):
    random = np.random.default_rng(0)
    first, zeroth = random.normal(1, 1, (40, 2, 1)), random.normal(1, 3, (40, 2, 1))
    is_finite = np.ones((40, 2), bool)
    for environment, step in bad:
        first[environment, step] = np.nan
        is_finite[environment, step] = False
    return Gradients(jnp.asarray(first), jnp.asarray(zeroth), jnp.asarray(is_finite))


def test_the_zeroth_order_stands_in_for_what_is_no_number():
    both = random_gradients(bad=[(3, 1)])
    assert_allclose(both.sound.first, both.first.at[3, 1].set(both.zeroth[3, 1]))


def test_what_is_longer_than_zeroth_order_noise_is_shortened_and_counted():
    """One of 40 is 10⁶ times as large; twice the root mean square of the zeroth order is three times what the others reach."""
    both = random_gradients(bad=[(3, 1)])
    first = both.first.at[7, 0].mul(1e6)
    found, is_shortened = Gradients(first, both.zeroth, both.is_finite).shortened(2.0)
    assert np.argwhere(is_shortened).tolist() == [[7, 0]]
    assert_allclose(found.first[7, 0], 2 * jnp.sign(first[7, 0]) * jnp.sqrt((both.zeroth[:, 0] ** 2).mean()))
    assert_allclose(jnp.delete(found.first, 7, axis=0), jnp.delete(first, 7, axis=0))
    untouched, _ = Gradients(first, both.zeroth, both.is_finite).shortened(np.inf)
    assert_allclose(untouched.first, first)
