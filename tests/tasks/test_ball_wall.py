"""The scenes' tasks."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjxgrad.estimators import first_and_zeroth_order
from mjxgrad.objective import closed_loop
from mjxgrad.rollouts import initial_state, rollout
from mjxgrad.scene import load_scene
from mjxgrad.tasks import SceneTask, ball_wall, scene_path, wall_softness
from tests.objective.test_task import CART

ANGLES = np.concatenate([np.arange(0.3, 1.2, 0.02), [0.612, 0.614]])
SOFT, STIFF = 10.0, 1e4


@pytest.fixture(scope="session")
def ends():
    """Where the ball ends, by stiffness; one compilation for both."""
    task = ball_wall()

    @jax.jit
    def throw(softness, angles):
        scene = task.scene.with_softness(softness)
        return jax.vmap(lambda angle: rollout(scene, task.start(angle), horizon=task.horizon).qpos[-1, 0])(angles)

    return {k: np.asarray(throw(wall_softness(k), jnp.asarray(ANGLES)[:, None])) for k in (SOFT, STIFF)}


def ends_in_c_mujoco(stiffness: float) -> np.ndarray:
    model = mujoco.MjModel.from_xml_path(str(scene_path("ball_wall")))
    model.pair("ball_wall").solref = [-stiffness, -2 * np.sqrt(stiffness)]
    data = mujoco.MjData(model)
    found = []
    for angle in ANGLES:
        mujoco.mj_resetData(model, data)
        data.qvel[:] = 2 * np.cos(angle), 2 * np.sin(angle)
        for _ in range(210):
            mujoco.mj_step(model, data)
        found.append(data.qpos[0])
    return np.array(found)


@pytest.mark.parametrize("stiffness", [SOFT, STIFF])
def test_the_ball_ends_where_it_does_in_c_mujoco(ends, stiffness):
    # Both solvers stop at a tolerance of 1e-8 per step, and impacts amplify what is left.
    np.testing.assert_allclose(ends[stiffness], ends_in_c_mujoco(stiffness), atol=1e-5)


def test_a_stiff_wall_blocks_or_is_cleared(ends):
    """The wall's front is at 0.19 m, the ball's radius 0.01 m; within 2 mrad the ball ends 0.1 m farther."""
    blocked, cleared = ends[STIFF][-2:]
    assert blocked < 0.18
    assert cleared > 0.25
    is_low = ANGLES < 0.6
    assert (ends[STIFF][is_low] < 0.19).all()
    assert (ends[STIFF][(ANGLES > 0.65) & (ANGLES < 1.15)] > 0.25).all()


def test_a_soft_wall_lets_every_throw_through_and_the_landscape_is_smooth(ends):
    order = np.argsort(ANGLES)
    angles, x = ANGLES[order], ends[SOFT][order]
    assert (x > 0.21).all()
    # The reach in free flight has a slope of at most 2 v²/g = 0.82 m/rad.
    assert np.abs(np.diff(x)).max() < 0.82 * np.diff(angles).max()


def test_the_wall_hides_the_target_from_low_throws_only(ends):
    cost = (ends[STIFF] - 0.38) ** 2
    assert cost[np.searchsorted(ANGLES[:-2], 0.98)] < 1e-4
    assert cost[ANGLES < 0.6].min() > 0.03


def test_a_missing_scene_is_named():
    with pytest.raises(FileNotFoundError, match=r"no scene no_such_task\.xml in "):
        scene_path("no_such_task")


@pytest.fixture(scope="session")
def cart():
    scene = load_scene(CART)
    state = initial_state(scene, qpos=jnp.array([0.3]), qvel=jnp.array([-0.5]))
    return SceneTask(scene, state, lambda trajectory: (trajectory.qpos**2).sum() + trajectory.ctrl.sum(), horizon=5)


def policy(params, state):
    return params["gain"] @ jnp.concatenate([state.qpos, state.qvel, state.time[None]])


POLICY_PARAMS = {"gain": jnp.array([[-1.5, -0.4, 3.0]])}


def test_a_scene_task_shows_the_states_that_its_policy_saw(cart):
    """The same actions, chosen again from these states, give the same rollout."""
    noise = jnp.array([[0.3], [-0.2], [0.1], [0.4], [-0.6]])
    outcome = jax.jit(lambda noise: cart.run(policy, POLICY_PARAMS, noise))(noise)
    controls = jax.vmap(lambda state: policy(POLICY_PARAMS, state))(outcome.states) + noise
    trajectory = rollout(cart.scene, cart.state, controls)
    np.testing.assert_allclose(outcome.cost, cart.cost(trajectory), rtol=1e-6)
    np.testing.assert_allclose(outcome.states.qpos, trajectory.qpos[:-1], rtol=1e-6)


def test_a_rollout_that_diverges_is_left_out_and_counted(cart):
    """One thrust in two is beyond all measure."""
    objective = closed_loop(cart, policy, 0.1, params=POLICY_PARAMS)

    class Bursting(type(objective)):
        def sample_noise(self, key):
            noise = super().sample_noise(key)
            return jnp.where(noise[0, 0] > 0, 1e9, 1.0) * noise

    bursting = Bursting(cart, objective.policy, objective.stddev, objective.unravel, objective.dim)
    first, zeroth = jax.jit(
        lambda key: first_and_zeroth_order(bursting, objective.ravel(POLICY_PARAMS), key, num_samples=32)
    )(jax.random.key(0))
    assert 4 < first.num_finite < 28
    assert first.num_finite == zeroth.num_finite
    assert np.isfinite(first.value).all()
    assert np.isfinite(zeroth.standard_error).all()
