"""Playground's and brax's environments by our step: their motion, a derivative that is its slope, and nothing left behind."""

import dataclasses
import re
import struct
import sys
import threading
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco.mjx
import numpy as np
import pytest

from mjxgrad.envs import playground
from mjxgrad.learning import Settings, learn
from mjxgrad.stepping import Slope, forward

# How many actions, and what is to be known: noise on observations and pushes have keys of their own.
NAMES = {
    "CartpoleSwingup": (8, {}),
    "CheetahRun": (8, {}),
    "HopperHop": (8, {}),
    "Go1JoystickFlatTerrain": (2, {"noise_config.level": 0.0, "pert_config.enable": False}),
}


class Object:
    """Steps as environments of other programs do."""

    def __init__(self):
        self.model = mujoco.mjx.put_model(mujoco.MjModel.from_xml_string(FALL), impl="jax")
        self.called = None

    def reset(self, data):
        return data

    def step(self, data):
        self.called = mujoco.mjx.step
        if data is None:
            raise RuntimeError("no data")
        return mujoco.mjx.step(self.model, data)


FALL = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


@pytest.fixture
def falling():
    thing = Object()
    return thing, mujoco.mjx.make_data(thing.model)


def test_the_step_is_ours_inside_and_theirs_outside(falling, monkeypatch):
    thing, data = falling
    theirs, counted = mujoco.mjx.step, []
    monkeypatch.setattr(playground, "step", lambda model, data, **settings: counted.append(settings) or data)
    right = playground.stepped_right(thing, contact=Slope())
    right.step(data)
    assert counted == [{"contact": Slope()}]
    assert mujoco.mjx.step is theirs


def test_after_an_error_the_step_is_theirs_again(falling):
    thing, _ = falling
    theirs = mujoco.mjx.step
    with pytest.raises(RuntimeError, match="no data"):
        playground.stepped_right(thing).step(None)
    assert mujoco.mjx.step is theirs


def test_other_threads_step_as_ever(falling, monkeypatch):
    thing, data = falling
    monkeypatch.setattr(playground, "step", lambda model, data, **_: data)
    playground.stepped_right(thing).step(data)
    monkeypatch.setattr(playground, "step", None)  # of which a call would be an error
    results = []
    thread = threading.Thread(target=lambda: results.append(jax.jit(thing.called)(thing.model, data)))
    thread.start()
    thread.join()
    assert len(results) == 1


@pytest.mark.parametrize(("place", "slope"), [(0.5, 1.0), (1.0, 0.0), (2.0, 0.0)])
def test_within_bounds_a_tolerance_has_the_derivative_zero(monkeypatch, place, slope):
    """Playground's formula, linear below 1 for brevity: by itself the derivative from 1 on is no number."""
    reward = types.ModuleType("reward")

    def tolerance(x, bounds):
        distance = jnp.where(x < bounds[0], bounds[0] - x, x - bounds[1])
        return jnp.where((bounds[0] <= x) & (x <= bounds[1]), 1.0, 1 - distance + 0.0 * jnp.exp(-(distance**2)))

    class Standing:
        def reset(self):
            return None

        def step(self, height):
            return reward.tolerance(height, bounds=(1.0, jnp.inf))

    reward.tolerance = tolerance
    monkeypatch.setitem(sys.modules, "mujoco_playground._src.reward", reward)
    right = playground.stepped_right(Standing())
    value, derivative = jax.value_and_grad(right.step)(jnp.array(place))
    assert value == Standing().step(place)
    assert derivative == slope
    assert reward.tolerance is tolerance


@pytest.fixture(scope="module")
def menagerie(tmp_path_factory):
    """Stands in for the download of the Go1's meshes, which are for the eye: its bodies have masses and its feet spheres."""
    mjx_env = pytest.importorskip("mujoco_playground._src.mjx_env", reason="pip install playground")
    from etils import epath

    folder = tmp_path_factory.mktemp("menagerie") / "unitree_go1" / "assets"
    folder.mkdir(parents=True)
    corners = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = (struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    content = bytes(80) + struct.pack("<I", len(faces)) + b"".join(triangles)
    for scene in (mjx_env.ROOT_PATH / "locomotion" / "go1" / "xmls").glob("*.xml"):
        for mesh in re.findall(r'file="([^"]+\.stl)"', scene.read_text(), flags=re.IGNORECASE):
            (folder / Path(mesh).name).write_bytes(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mjx_env, "MENAGERIE_PATH", epath.Path(folder.parents[1]))
        yield


@pytest.fixture(scope="module", params=list(NAMES))
def both(request, menagerie):
    """What an environment tells as it is, but with a solver that converges, and by our step: one start, the same actions."""
    from mujoco_playground import registry

    num_actions, options = NAMES[request.param]
    overrides = options | {"impl": "jax"}
    theirs = registry.load(request.param, config_overrides=overrides)
    # Theirs stop after 1 to 4 iterations, wherever they are then.
    option = theirs.mjx_model.opt.replace(iterations=100, ls_iterations=50)
    theirs._mjx_model = theirs.mjx_model.replace(opt=option)
    ours = playground.load(request.param, config_overrides=overrides)
    start = jax.jit(theirs.reset)(jax.random.PRNGKey(0))
    actions = jax.random.uniform(jax.random.key(3), (num_actions, ours.action_size), minval=-0.7, maxval=0.7)

    def told(env, actions):
        def advance(state, action):
            stepped = env.step(state, action)
            return stepped, (stepped.obs, stepped.reward)

        # A copy, for they write into the dictionaries of the state that they are given.
        return jax.lax.scan(advance, jax.tree.map(jnp.asarray, start), actions)[1]

    def worth(actions):
        """No two numbers of it count alike."""
        numbers = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(told(ours, actions))])
        return jnp.cos(jnp.arange(numbers.size)) @ numbers, numbers

    reference = jax.tree.leaves(jax.jit(lambda actions: told(theirs, actions))(actions))
    return jax.jit(jax.value_and_grad(worth, has_aux=True)), actions, np.concatenate([np.ravel(x) for x in reference])


@pytest.mark.slow
def test_observations_and_rewards_are_theirs(both):
    """Both solves stop within MuJoCo's tolerance of 1e-8 of the least cost, which is quadratic there: 1e-4 of the forces at most.

    Newton's last step leaves far less, unless it ends just within.
    """
    differentiate, actions, reference = both
    (_, numbers), _ = differentiate(actions)
    np.testing.assert_allclose(numbers, reference, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_the_gradient_is_the_slope(both):
    """Central differences along one direction; their error is the square of the width 1e-6, and rounding 1e-16 / 1e-6."""
    differentiate, actions, _ = both
    _, gradient = differentiate(actions)
    assert jnp.isfinite(gradient).all()
    direction = jax.random.normal(jax.random.key(5), actions.shape)
    width = 1e-6
    (high, _), _ = differentiate(actions + width * direction)
    (low, _), _ = differentiate(actions - width * direction)
    np.testing.assert_allclose((gradient * direction).sum(), (high - low) / (2 * width), rtol=1e-5)


@pytest.mark.slow
def test_their_auto_reset_cuts_the_derivative(menagerie):
    """An episode of one action: both copies are done, and what comes after depends on no action."""
    from mujoco_playground import wrapper

    env = wrapper.wrap_for_brax_training(playground.load("CartpoleSwingup"), episode_length=1)
    start = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))

    def after(actions):
        state = env.step(jax.tree.map(jnp.asarray, start), actions)
        return (state.obs, state.data.qpos), (state.done, state.reward)

    slopes, (done, _) = jax.jit(jax.jacfwd(after, has_aux=True))(jnp.full((2, 1), 0.3))
    np.testing.assert_array_equal(done, 1.0)
    for slope in slopes:
        np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.slow
def test_one_of_braxs_environments_steps_right():
    """The derivative of where its pendulum goes by the push is the slope."""
    envs = pytest.importorskip("brax.envs", reason="pip install brax")
    env = playground.stepped_right(envs.get_environment("inverted_pendulum", backend="mjx"))
    start = jax.jit(env.reset)(jax.random.PRNGKey(0))
    place = jax.jit(jax.value_and_grad(lambda action: env.step(start, action).obs @ jnp.arange(1.0, 5.0)))
    action, width = jnp.array([0.3]), 1e-5
    slope = (place(action + width)[0] - place(action - width)[0]) / (2 * width)
    np.testing.assert_allclose(place(action)[1][0], slope, rtol=1e-7)


@pytest.fixture(scope="module")
def walker():
    pytest.importorskip("mujoco_playground", reason="pip install playground")
    return playground.environment("WalkerWalk", num_starts=4)


@pytest.mark.slow
def test_a_task_has_their_observation_and_reward(walker):
    """By their functions in the state that their own step leads to; both solves converge, as in the test above."""
    theirs = playground.load("WalkerWalk")
    action = jax.random.uniform(jax.random.key(3), (walker.num_actions,), minval=-0.9, maxval=0.9)
    start = jax.jit(lambda key: walker.reset(key))(jax.random.key(1))
    stepped = jax.jit(lambda action: walker.step(start, action))(action)
    data = mujoco.mjx.make_data(theirs.mj_model, impl="jax").replace(qpos=start.physics.qpos, qvel=start.physics.qvel)
    first = jax.eval_shape(theirs.reset, jax.random.PRNGKey(0))
    first = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), first).replace(data=data)

    @jax.jit
    def told(action):
        after = forward(theirs.mjx_model, theirs.step(first, action).data)
        return after.qpos, theirs._get_obs(after, {}), theirs._get_reward(after, action, {}, {})

    for ours, reference in zip((stepped.physics.qpos, stepped.obs, stepped.reward), told(action), strict=True):
        np.testing.assert_allclose(ours, reference, rtol=1e-7, atol=1e-7)
    assert (walker.frame_skip, walker.episode_length, float(walker.interval)) == (10, 1000, 0.025)


@pytest.mark.slow
def test_the_reward_of_standing_has_a_derivative(walker):
    """Upright and taller than 1.2 m: only a speed below 1 m/s changes the reward."""
    rest = walker.start(jax.random.key(0))

    @jax.jit
    def reward(speed):
        state = dataclasses.replace(rest, qpos=0 * rest.qpos, qvel=jnp.zeros(9).at[1].set(speed))
        return walker.rewards(state, jnp.zeros(6), state, None)["task"]

    value, slope = jax.jit(jax.value_and_grad(reward))(0.8)
    width = 1e-6
    np.testing.assert_allclose(slope, (reward(0.8 + width) - reward(0.8 - width)) / (2 * width), rtol=1e-6)
    assert 0 < value < 1
    assert slope > 0


@pytest.mark.slow
def test_a_task_is_learnt(walker):
    settings = Settings(num_environments=4, window=2, actor_layers=(8,), critic_layers=(8,))
    learned = learn(walker, jax.random.key(0), num_updates=2, settings=settings, progress=False)
    assert jnp.isfinite(learned.history["reward"]).all()
    np.testing.assert_array_equal(learned.history["not_finite"], 0.0)


@pytest.mark.slow
def test_tasks_of_other_suites_are_refused(menagerie):
    with pytest.raises(ValueError, match="dm_control suite without targets that move, got 'Go1Joystick"):
        playground.environment("Go1JoystickFlatTerrain")
