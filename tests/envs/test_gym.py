"""Environments in gymnasium: what its checks ask for, one copy and many, and an agent that learns there."""

import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mjxgrad.envs import ENVIRONMENTS
from mjxgrad.envs.diffrl import CartPole
from mjxgrad.envs.gym import GymEnv, GymVectorEnv, gym_name
from mjxgrad.rollouts import initial_state, render
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path
from tests.envs.test_environment import heavier

LENGTH = 3
ACTION = np.array([0.6], np.float32)


@pytest.fixture(scope="module")
def cart():
    return CartPole(load_scene(scene_path("cartpole")), frame_skip=2, episode_length=LENGTH)


@pytest.fixture(scope="module")
def one(cart):
    return GymEnv(cart, render_mode="rgb_array")


@pytest.fixture(scope="module")
def many(cart):
    return GymVectorEnv(cart, 3)


@pytest.fixture(scope="module")
def episode(many):
    """What each step of an episode and the first of the next one told."""
    many.reset(seed=2)
    return [many.step(np.tile(ACTION, (3, 1))) for _ in range(LENGTH + 1)]


def test_all_environments_are_registered_under_names_like_gymnasiums():
    for name in ENVIRONMENTS:
        assert gymnasium.spec(gym_name(name)).kwargs == {"environment": name}
    assert gym_name("half_cheetah") == "mjxgrad/HalfCheetah-v0"
    assert gym_name("diffrl_ant") == "mjxgrad/DiffRLAnt-v0"


def test_make_imports_what_registers_them_and_make_vec_makes_one_program():
    """The limit of steps is the environment's own."""
    made = gymnasium.make("mjxgrad.envs.gym:mjxgrad/DiffRLCartpole-v0")
    assert isinstance(made.unwrapped, GymEnv)
    assert made.unwrapped.environment.episode_length == 240
    assert made.spec.max_episode_steps is None
    copies = gymnasium.make_vec("mjxgrad/DiffRLCartpole-v0", num_envs=5)
    assert isinstance(copies, GymVectorEnv)
    assert copies.observation_space.shape == (5, 5)


def test_gymnasiums_check_passes(one):
    """It wishes for bounded observations; speeds have none. Pictures are tested below."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box observation space m(in|ax)imum value is -?infinity")
        # It makes another one, by the name under which one is registered; this one is not.
        warnings.filterwarnings("ignore", message=".*not possible to test alternative render modes")
        check_env(one, skip_render_check=True)


def test_it_is_shown_by_its_scene_and_its_sizes(one, many):
    """Where the cart is, sine and cosine of the pole, and two speeds."""
    assert repr(one) == "GymEnv(cartpole.xml: 5 observed numbers, 1 action)"
    assert repr(many) == "GymVectorEnv(cartpole.xml: 5 observed numbers, 1 action, 3 copies)"


def test_one_copy_steps_as_the_environment(one, cart):
    """The state can be told from what is seen."""
    obs, _ = one.reset(seed=4)
    physics = initial_state(cart.scene, jnp.array([obs[0], np.arctan2(obs[2], obs[3])]), obs[[1, 4]])
    seen, reward, *ends, info = one.step(ACTION)
    course = cart.reset(jax.random.key(0))
    after = jax.jit(lambda physics, action: cart.step(type(course)(**{**vars(course), "physics": physics}), action))
    expected = after(physics, jnp.asarray(ACTION))
    np.testing.assert_allclose(seen, expected.obs, rtol=1e-12)
    np.testing.assert_allclose(reward, expected.reward, rtol=1e-12)
    assert ends == [False, False]
    assert set(info) == {"pole", "cart", "diverged"}
    np.testing.assert_allclose(info["pole"] + info["cart"], reward, rtol=1e-14)


def test_a_seed_is_an_episode_and_the_next_one_another(one):
    first, again, next_one = one.reset(seed=1)[0], one.reset(seed=1)[0], one.reset()[0]
    np.testing.assert_array_equal(first, again)
    assert np.abs(next_one - first).min() > 0


def test_one_copy_is_truncated_when_its_time_is_up(one):
    one.reset(seed=1)
    ends = [one.step(ACTION)[2:4] for _ in range(LENGTH)]
    assert ends == [(False, False)] * (LENGTH - 1) + [(False, True)]


def test_copies_begin_anew_in_the_step_in_which_they_end(episode, many):
    assert many.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    for step, (_, _, terminated, truncated, infos) in enumerate(episode, 1):
        np.testing.assert_array_equal(truncated, [step == LENGTH] * 3)
        assert not terminated.any()
        assert ("final_obs" in infos) == (step == LENGTH)


def test_the_last_observation_and_metrics_are_told_beside_the_first_ones(episode):
    """The reward of the last step is that of its own metrics; those of the new episode are still zero."""
    obs, reward, _, _, infos = episode[LENGTH - 1]
    last = np.stack(infos["final_obs"])
    np.testing.assert_allclose(infos["final_info"]["pole"] + infos["final_info"]["cart"], reward, rtol=1e-14)
    np.testing.assert_array_equal(infos["pole"], 0.0)
    # In a step of 17 ms no cart moves farther than 0.1 m: the observation before leads to the last one, not to the first.
    assert np.abs(last[:, 0] - episode[LENGTH - 2][0][:, 0]).max() < 0.1
    assert np.abs(obs[:, 0] - last[:, 0]).max() > 0.1


def test_infos_are_laid_out_as_gymnasiums_own(episode, one):
    """Keys, types and numbers of axes of gymnasium's loop over copies."""
    theirs = SyncVectorEnv([lambda: one], autoreset_mode=AutoresetMode.SAME_STEP)
    theirs.reset(seed=0)
    for _, _, _, _, infos in episode[:LENGTH]:
        expected = theirs.step(ACTION[None])[-1]
        assert jax.tree.map(_layout, infos) == jax.tree.map(_layout, expected)


def _layout(x):
    return np.ndim(x), np.asarray(x).dtype.kind


def test_each_copy_has_its_own_random_mass(cart):
    """20 N for 17 ms speed them by up to 0.3 m/s, the heaviest by half of it."""
    copies = GymVectorEnv(CartPole(cart.scene, frame_skip=2, randomisation=heavier), 4)
    before, _ = copies.reset(seed=0)
    after, *_ = copies.step(np.ones((4, 1), np.float32))
    gained = after[:, 1] - before[:, 1]
    assert gained.max() > 1.2 * gained.min() > 0


def test_pictures_show_the_present_state(one):
    try:
        one.reset(seed=0)
        first = one.render()
    except render.RenderingUnavailableError as error:
        pytest.skip(str(error))
    assert first.dtype == np.uint8
    assert first.shape == (360, 640, 3)
    one.step(ACTION)
    assert (one.render() != first).any()


@pytest.mark.parametrize("kind", [GymEnv, GymVectorEnv])
def test_an_unknown_environment_or_render_mode_is_refused(cart, kind):
    with pytest.raises(ValueError, match=r"name must be one of ant, .* got 'dog'"):
        kind("dog")
    with pytest.raises(ValueError, match="render_mode must be \"rgb_array\" or None, got 'human'"):
        kind(cart, render_mode="human")
    with pytest.raises(ValueError, match=r"an option must be one of 'render_mode', 'height', .* got 'widht'"):
        kind(cart, widht=64)


def test_a_number_of_copies_must_be_a_count(cart):
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        GymVectorEnv(cart, num_envs=0)


@pytest.mark.parametrize("kind", [GymEnv, GymVectorEnv])
def test_what_needs_a_reset_says_so_as_gymnasium_does(cart, kind):
    env = kind(cart, render_mode="rgb_array")
    for method, given in ((env.step, [ACTION]), (env.render, [])):
        said = rf"Cannot call env\.{method.__name__}\(\) before calling env\.reset\(\)"
        with pytest.raises(gymnasium.error.ResetNeeded, match=said):
            method(*given)


def test_an_action_of_another_form_is_refused(many):
    many.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must have shape \(3, 1\), got \(2, 1\)$"):
        many.step(np.zeros((2, 1)))
