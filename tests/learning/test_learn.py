"""The loop: it goes on to the bit, says what it left out, and ends with a policy that does the job in C MuJoCo."""

import dataclasses
import functools
import os
import subprocess
import sys
import textwrap

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

from mjxgrad import envs, initial_state, learning
from mjxgrad.envs.diffrl import CartPole
from mjxgrad.learning.learner import ActorCritic
from mjxgrad.loop import side_by_side
from tests.loop.test_checkpoint import KilledError, kill_at

SMALL = learning.Settings(num_environments=4, window=3, actor_layers=(6,), critic_layers=(6,), critic_iterations=2)


@pytest.fixture(scope="module")
def cartpole():
    return envs.load("diffrl_cartpole")


@pytest.mark.parametrize(("interval", "window"), [(1 / 60, 16), (0.05, 5), (0.008, 33), (0.2, 5)])
def test_what_is_left_out_lasts_the_same_seconds_at_any_rate(interval, window):
    """Of actions of 1/60 s: 16, 0.99 and 0.9 of each; longer ones than 50 ms count as 50. What is given stays."""
    found, seconds = learning.Settings().counted(interval), min(interval, 0.05)
    assert found.window == window
    assert_allclose(found.discount ** (1 / seconds), 0.99**60, rtol=1e-12)
    assert_allclose(found.trace ** (1 / seconds), 0.9**60, rtol=1e-12)
    given = learning.Settings(window=7, discount=0.9, trace=0.5, alpha=0.5)
    assert dataclasses.astuple(given.counted(interval)) == dataclasses.astuple(given)


def test_a_window_that_is_left_out_fits_the_batches_of_the_value_function():
    odd = learning.Settings(num_environments=6, critic_batches=4).counted(0.02)
    assert odd.num_environments * odd.window % 4 == 0
    assert abs(odd.window - 16 / 1.2) <= 1
    assert learning.Settings(has_critic=False).counted(0.02).trace == 1


def test_an_interrupted_run_goes_on_to_the_bit(cartpole, key, tmp_path):
    learn = functools.partial(learning.learn, cartpole, key, num_updates=2, log_every=1, settings=SMALL)
    whole = learn()
    with pytest.raises(KilledError):
        learn(checkpoint=tmp_path / "run", log=kill_at(1, KilledError))
    resumed = learn(checkpoint=tmp_path / "run")
    assert eqx.tree_equal(resumed.learner, whole.learner)
    for name in whole.history.keys() - {"seconds"}:
        np.testing.assert_array_equal(resumed.history[name], whole.history[name])
    longer = learn(num_updates=3, checkpoint=tmp_path / "run")
    np.testing.assert_array_equal(longer.history["reward"][:2], whole.history["reward"])
    assert int(longer.learner.num_updates) == 3
    other = dataclasses.replace(SMALL, discount=0.9)
    with pytest.raises(
        ValueError, match=r"of the same run, got .* settings: discount was .* and is 0.9; use the settings"
    ):
        learning.learn(cartpole, key, num_updates=2, settings=other, checkpoint=tmp_path / "run")
    whole.policy.save(tmp_path / "policy.npz")
    with pytest.raises(ValueError, match=r"but it is a saved policy; give another path to begin anew$"):
        learn(checkpoint=tmp_path / "policy.npz")
    reward = float(whole.history["reward"][-1])
    assert repr(whole).startswith(f"Learned(Reward {reward:.4g} a step in the last of 2 updates, ")
    assert repr(whole).endswith(f". {whole.policy})")


def _judged_by(reward):
    """A class whose name is always the same, with the code that it is given for its reward."""

    class Judged(CartPole):
        def rewards(self, before, action, after, memory):
            return {"speed": reward(after.qvel[0])}

    return Judged


def test_a_checkpoint_of_another_reward_is_refused(cartpole, key, tmp_path):
    """Same name, same numbers, other code: what was learned for the old reward is not the answer for the new one."""
    settings = dataclasses.replace(SMALL, has_critic=False, trace=1.0)
    learn = functools.partial(learning.learn, key=key, num_updates=1, settings=settings, checkpoint=tmp_path / "run")
    learn(_judged_by(lambda speed: speed)(cartpole.scene))
    with pytest.raises(ValueError, match=r"of the same run, got .* of one with other settings: .*environment"):
        learn(_judged_by(lambda speed: -speed)(cartpole.scene))


def test_an_interruption_in_the_middle_of_a_save_loses_nothing(cartpole, key, tmp_path, monkeypatch):
    """Ctrl-C at the first time that the file is written: it is written again on the way out."""
    sync, told = os.fsync, []

    def interrupted(handle):
        monkeypatch.setattr("os.fsync", sync)
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupted)
    learn = functools.partial(learning.learn, cartpole, key, num_updates=2, log_every=1, settings=SMALL)
    assert len(learn(checkpoint=tmp_path / "run").history["reward"]) == 1
    learn(checkpoint=tmp_path / "run", log=lambda update, metrics: told.append(update))
    assert told == [2]


class Spoiled(CartPole):
    """Its reward has an infinite slope where the cart is to the right, or, where so much is lost, is no number at all."""

    lost: jax.Array = eqx.field(kw_only=True)

    def rewards(self, before, action, after, memory):
        terms = super().rewards(before, action, after, memory)
        corner = jnp.sqrt(jnp.where(after.qpos[0] > 0, 0.0 * action[0], 1.0))
        return {**terms, "corner": corner + self.lost * after.qpos[0]}


def test_derivatives_that_are_no_numbers_are_counted_and_replaced(cartpole, key):
    """Where the cart is to the right the derivative of √0 makes NaN of that window's, up to there."""
    cornered = Spoiled(cartpole.scene, frame_skip=2, lost=jnp.zeros(()))
    run = learning.learn(cornered, key, num_updates=1, log_every=1, settings=SMALL)
    assert 0 < run.history["not_finite"][0] < 1
    assert run.history["skipped"][0] == 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(run.policy.actor))


def test_without_any_number_nothing_is_changed_and_it_says_so(cartpole, key):
    lost = Spoiled(cartpole.scene, frame_skip=2, lost=jnp.array(jnp.nan, float))  # of one type with zeros: one program
    start = eqx.filter_jit(ActorCritic(lost, SMALL.counted(1 / 60), 1).init)(key)
    run = learning.learn(lost, key, num_updates=1, log_every=1, settings=SMALL)
    assert run.history["skipped"][0] == 1
    # Up to rounding, since the start is compiled on its own there; one step of Adam would be 2e-3.
    jax.tree.map(lambda x, y: assert_allclose(x, y, atol=1e-12), run.policy.actor, start.policy.actor)


def test_a_policy_is_judged_by_mujoco_itself(cartpole, key):
    """Against a loop around mj_step, from the same start, by a policy that pushes by the pole's lean; 20 actions of two steps."""
    short = CartPole(cartpole.scene, frame_skip=2, episode_length=20)

    def policy(obs):
        return 0.8 * obs[2:3] - 0.1 * obs[1:2]

    found = learning.evaluate(short, policy, key, num_episodes=1)
    start = short.reset(jax.random.split(key, 1)[0])
    model = cartpole.scene.to_mujoco()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start.physics.qpos, start.physics.qvel
    total = 0.0
    for _ in range(20):
        place, angle, speed, rate = *data.qpos, *data.qvel
        data.ctrl[:] = 0.8 * np.sin(angle) - 0.1 * speed
        mujoco.mj_step(model, data, 2)
        place, angle, speed, rate = *data.qpos, *data.qvel
        upward = np.arctan2(np.sin(angle), np.cos(angle))
        total -= upward**2 + 0.1 * rate**2 + 0.05 * place**2 + 0.1 * speed**2
    assert_allclose(found.returns[0], total, rtol=1e-9)
    assert_allclose(found.qpos[0, -1], data.qpos, rtol=1e-9)


class Falls(CartPole):
    """Over as soon as the pole has turned by a quarter from where it hung."""

    def start(self, key):
        return initial_state(self.scene, jnp.array([0.0, 1.0]))

    def is_over(self, state):
        return state.qpos[1] > 2.0


def test_an_evaluation_is_shown_by_its_mean_return_with_its_error():
    """Of 1, 2, 3 and 6: the mean is 3, the variance 14/3, and the error its root over 2, 1.08."""
    lengths, ended = jnp.array([5, 5, 5, 9]), jnp.array([True, True, False, False])
    found = learning.Evaluation(jnp.array([1.0, 2.0, 3.0, 6.0]), lengths, ended, jnp.zeros((4, 10, 1)), {})
    assert repr(found) == "Evaluation(4 episodes: mean return 3 ± 1.08, mean length 6, 2 ended early)"
    one = jax.tree.map(lambda x: x[:1], found)
    assert repr(one) == "Evaluation(1 episode: mean return 1, mean length 5, 1 ended early)"
    assert "returns=" in repr(jax.eval_shape(lambda: found)), "shapes have no mean"


def test_an_evaluation_ends_with_the_episode(cartpole, key):
    """The pole falls from 1 rad; what would follow 2 rad is not counted."""
    falls = Falls(cartpole.scene, frame_skip=2, episode_length=60)
    found = learning.evaluate(falls, lambda obs: jnp.zeros(1), key, num_episodes=1)
    length = int(found.lengths[0])
    assert bool(found.terminated[0])
    assert 1 < length < 60
    angles = np.asarray(found.qpos[0, :, 1])
    assert angles[length - 1] <= 2.0 < angles[length]
    assert_allclose(angles[length:], angles[length])


def test_without_a_value_function_the_mean_reward_is_climbed(cartpole, key):
    """The gradient of one update against that of a plain sum over windows, and of both halves; with hardly any noise."""
    settings = learning.Settings(
        num_environments=4, window=3, actor_layers=(6,), stddev=(1e-9, 1e-9), largest_sample=np.inf, largest_change=np.inf,
        discount=1.0, trace=1.0, alpha=1.0, has_critic=False,
    )  # fmt: skip
    run = learning.learn(cartpole, key, num_updates=1, settings=settings)
    before = eqx.filter_jit(ActorCritic(cartpole, settings.counted(1 / 60), 1).init)(key)

    def loss(actor):
        def advance(state, _):
            stepped, state = cartpole.step_on(state, jnp.tanh(actor(before.policy.normaliser(state.obs))))
            return state, stepped.reward

        def one(state):
            return jax.lax.scan(advance, state, length=3)[1].sum()

        return -jax.vmap(one)(before.environments) / (4 * 3)

    gradients = jax.tree.leaves(jax.jit(jax.jacrev(loss))(before.policy.actor))
    first, second = np.concatenate([x.reshape(4, -1) for x in gradients], axis=1).reshape(2, 2, -1).sum(axis=1)
    norm = np.linalg.norm(first + second)
    assert_allclose(run.history["gradient_norm"][0], norm, rtol=1e-6)
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    assert_allclose(run.history["agreement"][0], cosine, rtol=1e-6)
    # Windows follow one another, and nothing is fitted.
    assert run.learner.environments.num_steps.max() > 3
    assert all(not x.any() for x in jax.tree.leaves(run.learner.critic.network.layers[-1]))


def test_gradients_are_clipped_by_their_norm():
    """3 and 4 have norm 5, clipped to 1. Adam's first moment is 0.3 of what it is given."""
    optimiser, _ = learning.learner.optimisers(learning.Settings(), 5)
    _, moments = optimiser.update(jnp.array([3.0, 4.0]), optimiser.init(jnp.zeros(2)))
    assert_allclose(optax.tree.get(moments, "mu"), [0.18, 0.24], rtol=1e-6)


def test_a_step_changes_the_noisy_policy_by_no_more_than_its_limit(cartpole, key):
    """By the relative entropy of normal distributions, at the starts, which are all that windows of one action observe.

    Steps are shortened and not turned. That entropy grows with the square of a step is off by the network's curvature.
    """
    settings = dataclasses.replace(SMALL, window=1, critic_batches=2, stddev=(0.4, 0.4), actor_rate=0.1)
    before = eqx.filter_jit(ActorCritic(cartpole, settings.counted(1 / 60), 1).init)(key)

    def learnt(most):
        run = learning.learn(cartpole, key, num_updates=1, settings=dataclasses.replace(settings, largest_change=most))
        obs = before.policy.normaliser(before.environments.obs)
        old, new = (jax.vmap(actor)(obs) for actor in (before.policy.actor, run.policy.actor))
        steps = jax.tree.map(lambda x, y: np.asarray(y - x), before.policy.actor, run.policy.actor)
        entropy = float(((new - old) ** 2).sum(axis=1).mean() / (2 * 0.4**2))
        return np.concatenate([x.ravel() for x in jax.tree.leaves(steps)]), entropy, float(run.history["change"][0])

    free, wanted, told = learnt(np.inf)
    assert_allclose(told, wanted, rtol=1e-6)
    short, changed, told = learnt(1e-4)
    assert_allclose(told, wanted, rtol=1e-6)
    assert wanted > 1e-2
    assert_allclose(short, (1e-4 / wanted) ** 0.5 * free, rtol=1e-6, atol=1e-9)
    assert_allclose(changed, 1e-4, rtol=0.3)


@pytest.mark.parametrize(("decay", "rates"), [(None, [0.5, 0.4, 0.3]), (0.9, [0.5, 0.45, 0.405])])
def test_the_rate_falls_to_zero_or_by_a_share(decay, rates):
    """Adam's steps along a gradient that stays the same are the rates; of five updates, three."""
    settings = learning.Settings(actor_rate=0.5, actor_decay=decay)
    optimiser, _ = learning.learner.optimisers(settings, 5)
    gradient = jnp.ones(1)
    moments = optimiser.init(gradient)
    for rate in rates:
        change, moments = optimiser.update(gradient, moments)
        assert_allclose(change, [-rate], rtol=1e-6)


_PROGRAM = """
    import sys

    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    kind, path, index, port = sys.argv[1:]
    if kind == "devices":
        jax.config.update("jax_num_cpu_devices", 4)
    elif kind == "processes":
        jax.distributed.initialize(f"localhost:{port}", 2, int(index))
    from mjxgrad import envs, learning

    small = learning.Settings(num_environments=8, window=3, actor_layers=(6,), critic_layers=(6,))
    run = learning.learn(envs.load("diffrl_cartpole"), jax.random.key(0), num_updates=2, settings=small, checkpoint=path)
    assert jax.device_count() == {"one": 1, "devices": 4, "processes": 2}[kind]
    if jax.process_index() == 0:
        np.savez(path + ".npz", *map(np.asarray, jax.tree.leaves(run.policy)))
"""


def _numbers(kind, folder, count=1):
    """Learn in so many processes and return the policy's numbers."""
    path = str(folder / kind)
    arguments = [sys.executable, "-c", textwrap.dedent(_PROGRAM), kind, path]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    runs = [
        subprocess.Popen([*arguments, str(i), "29417"], env=environment, stderr=subprocess.PIPE, text=True)
        for i in range(count)
    ]
    for run in runs:
        _, errors = run.communicate(timeout=600)
        assert run.returncode == 0, errors
    with np.load(f"{path}.npz") as archive:
        return [archive[name] for name in archive.files]


def _stronger(cartpole):
    return dataclasses.replace(
        cartpole, scene=cartpole.scene.with_model(actuator_gainprm=3 * cartpole.scene.model.actuator_gainprm)
    )


@pytest.mark.slow
def test_seeds_and_environments_side_by_side_learn_as_each_alone(cartpole, key):
    """Up to the order of sums in a batch; of three environments with two seeds each, the second seed of the last."""
    keys, stronger = jax.random.split(key, 2), _stronger(cartpole)
    together = learning.learn([cartpole, cartpole, stronger], keys, num_updates=2, settings=SMALL)
    assert together.history["reward"].shape == (2, 3, 2)
    alone = learning.learn(stronger, keys[1], num_updates=2, settings=SMALL)
    pairs = zip(jax.tree.leaves(together.policy), jax.tree.leaves(alone.policy), strict=True)
    for all_of_them, mine in pairs:
        assert_allclose(all_of_them[2, 1], mine, rtol=1e-8, atol=1e-10)
        assert_allclose(all_of_them[0], all_of_them[1], rtol=1e-8, atol=1e-10)
    assert not np.allclose(together.history["reward"][:, 0], together.history["reward"][:, 2], rtol=1e-3)


def test_environments_share_all_numbers_but_those_that_differ(cartpole):
    """What all share is not copied for each of them."""
    both, axes = side_by_side([cartpole, _stronger(cartpole)])
    numbers = jax.tree.leaves(eqx.filter(both, eqx.is_array))
    (gain,) = (x for x, axis in zip(numbers, axes, strict=True) if axis == 0)
    assert_allclose(gain[1], 3 * gain[0], rtol=1e-6)
    assert len(numbers) == len(jax.tree.leaves(eqx.filter(cartpole, eqx.is_array)))


@pytest.mark.slow
def test_several_devices_and_processes_learn_the_same(tmp_path):
    """Sums over environments are done in another order, and Adam divides by gradients: some cancel to a millionth of the sum."""
    one = _numbers("one", tmp_path)
    for kind, count in (("devices", 1), ("processes", 2)):
        for mine, theirs in zip(one, _numbers(kind, tmp_path, count), strict=True):
            assert_allclose(mine, theirs, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_a_swing_up_is_learned_in_minutes(cartpole):
    """Upright, within 0.2 rad, in the last second in C MuJoCo, from nine of ten starts."""
    settings = learning.Settings(alpha=1.0)
    run = learning.learn(cartpole, jax.random.key(0), num_updates=1200, settings=settings)
    judged = learning.evaluate(cartpole, run.policy, jax.random.key(1), num_episodes=20)
    assert np.mean(np.all(np.cos(judged.qpos[:, -60:, 1]) > np.cos(0.2), axis=1)) >= 0.9
