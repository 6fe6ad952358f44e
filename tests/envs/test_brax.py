"""Environments in brax: its wrappers reset and time out, its learners learn."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxgrad.envs import load
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path
from tests.envs.test_environment import RAIL, Cart, heavier

_HOW = "pip install brax"
training = pytest.importorskip("brax.envs.wrappers.training", reason=_HOW)
apg = pytest.importorskip("brax.training.agents.apg.train", reason=_HOW)
ppo = pytest.importorskip("brax.training.agents.ppo.train", reason=_HOW)
BraxEnv = pytest.importorskip("mjxgrad.envs.brax", reason=_HOW, exc_type=ImportError).BraxEnv

pytestmark = pytest.mark.slow
ACTIONS = jnp.array([[0.6], [-0.4]])


@pytest.fixture(scope="module")
def cart():
    """Its own time is up after two actions, of which brax is to know nothing."""
    return Cart(load_scene(scene_path("cartpole")), frame_skip=2, episode_length=2, randomisation=heavier)


@pytest.fixture(scope="module")
def wrapped(cart):
    """Two copies, three actions an episode."""
    env = training.wrap(BraxEnv(cart), episode_length=3)
    return jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2)), jax.jit(env.step), env


def at_the_end(state, copy):
    """The same with one copy's cart beyond the rail."""
    qpos = state.pipeline_state.physics.qpos.at[copy, 0].set(RAIL + 0.1)
    return eqx.tree_at(lambda s: s.pipeline_state.physics.qpos, state, qpos)


def copied(state):
    """Their wrappers write into the dictionaries of the state that they are given."""
    return jax.tree.map(lambda x: x, state)


def test_steps_are_those_of_the_environment(cart):
    env = BraxEnv(cart)
    state = jax.jit(env.reset)(jax.random.PRNGKey(3))
    stepped = jax.jit(env.step)(state, ACTIONS[0])
    own = cart.randomised(state.info["copy_key"])
    expected = jax.jit(lambda state, action: own.step(state, action))(state.pipeline_state, ACTIONS[0])
    np.testing.assert_allclose(stepped.obs, expected.obs, rtol=1e-12)
    np.testing.assert_allclose(stepped.reward, expected.reward, rtol=1e-12)
    assert set(stepped.metrics) == set(state.metrics) == {"pole", "cart", "push", "diverged"}
    assert (env.observation_size, env.action_size) == (5, 1)


def test_keys_of_both_kinds_are_taken(cart):
    env = BraxEnv(cart)
    np.testing.assert_array_equal(env.reset(jax.random.PRNGKey(3)).obs, env.reset(jax.random.key(3)).obs)


def test_time_is_up_by_braxs_wrapper_alone(wrapped):
    """After three actions, not after the environment's own two; the state is then the first one again."""
    first, step, _ = wrapped
    state, ends = copied(first), []
    for _ in range(3):
        state = step(state, ACTIONS)
        ends.append((state.done.tolist(), state.info["truncation"].tolist()))
    assert ends == [([0, 0], [0, 0]), ([0, 0], [0, 0]), ([1, 1], [1, 1])]
    np.testing.assert_array_equal(state.obs, first.obs)
    np.testing.assert_array_equal(state.pipeline_state.num_steps, 0)


def test_an_end_for_good_is_done_and_not_truncated(wrapped):
    first, step, _ = wrapped
    state = step(at_the_end(copied(first), copy=1), ACTIONS)
    assert state.done.tolist() == [0, 1]
    assert state.info["truncation"].tolist() == [0, 0]
    np.testing.assert_array_equal(state.obs[1], first.obs[1])


def test_nothing_after_an_end_depends_on_an_action_before_it(wrapped):
    first, _, env = wrapped
    begun = at_the_end(copied(first), copy=1)
    slope = jax.jit(jax.jacfwd(lambda actions: env.step(copied(begun), actions).obs))(ACTIONS)
    np.testing.assert_array_equal(slope[1], 0.0)
    assert np.abs(slope[0, :, 0]).max() > 0


def test_copies_keep_their_own_masses_beyond_an_end(wrapped):
    first, step, _ = wrapped
    state = step(at_the_end(copied(first), copy=1), ACTIONS)
    before, after = (jax.tree.leaves(x.info["changes"]) for x in (first, state))
    for then, now in zip(before, after, strict=True):
        np.testing.assert_array_equal(then, now)
    assert any(np.ptp(x, axis=0).max() > 0 for x in before)


@pytest.fixture
def learning(monkeypatch):
    """What brax's learners need, and the returns that they tell of."""
    # brax 0.14.2 calls what jax 0.10 has removed.
    monkeypatch.setattr(jax, "device_put_replicated", _replicated, raising=False)
    returns = []
    with jax.enable_x64(False):
        environment = load("diffrl_cartpole")
        settings = {
            "environment": BraxEnv(environment),
            "episode_length": environment.episode_length,
            "num_evals": 3,
            "num_eval_envs": 16,
            "normalize_observations": True,
            "progress_fn": lambda step, metrics: returns.append(float(metrics["eval/episode_reward"])),
        }
        yield settings, returns


def _replicated(tree, devices):
    return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)


def test_braxs_analytic_policy_gradient_learns_to_swing_up(learning):
    """From a mean return of −2000 by a fifth at least."""
    settings, returns = learning
    apg.train(**settings, policy_updates=100, num_envs=32, learning_rate=1e-2, max_gradient_norm=1.0)
    assert returns[-1] > 0.8 * returns[0]


def test_braxs_ppo_learns_to_swing_up(learning):
    """From a mean return of −1900 by a third at least."""
    settings, returns = learning
    sizes = {"num_envs": 64, "unroll_length": 16, "batch_size": 64, "num_minibatches": 8, "num_updates_per_batch": 4}
    ppo.train(**settings, **sizes, num_timesteps=250_000, learning_rate=1e-3, discounting=0.98, reward_scaling=0.1)
    assert returns[-1] > 0.67 * returns[0]
