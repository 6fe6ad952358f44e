"""C MuJoCo behind `rollout`: the same motion, mapped over starts, controls and softness; what it cannot do is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.tasks import scene_path

HORIZON = 40


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(scene_path("servo_arm"))


def _rollout(scene, qvel, controls, **settings):
    return mg.rollout(scene, mg.initial_state(scene, qvel=qvel), controls, **settings)


def test_the_motion_is_that_of_our_own_step(scene):
    random = np.random.default_rng(0)
    qvel, controls = random.normal(size=(6, scene.model.nv)), random.normal(size=(6, HORIZON, scene.model.nu))
    ours, theirs = (
        jax.jit(jax.vmap(lambda v, u, engine=engine: _rollout(scene, v, u, engine=engine)))(qvel, controls)
        for engine in ("mjx", "mujoco")
    )
    # Both solve to the file's tolerance, which impacts amplify.
    np.testing.assert_allclose(theirs.qpos, ours.qpos, atol=1e-6)
    np.testing.assert_allclose(theirs.qvel, ours.qvel, atol=1e-4)
    for name in ("ctrl", "diverged", "first_bad_step"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name))
    np.testing.assert_allclose(theirs.final.time, ours.final.time, rtol=1e-12)


def test_starts_and_softness_may_be_mapped_over_at_once():
    """A ball that bounces, against one call after another."""
    scene = mg.load_scene(
        """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .11"><freejoint/>
        <geom size=".1"/></body></worldbody></mujoco>"""
    )
    stiffness, speeds = jnp.array([1e3, 1e4]), jnp.array([0.0, -1.0, -2.0])

    def last(stiffness, speed):
        soft = scene.with_softness(mg.Softness(stiffness=stiffness, damping_ratio=1.0))
        qvel = jnp.zeros(scene.model.nv).at[2].set(speed)
        return mg.rollout(soft, mg.initial_state(soft, qvel=qvel), horizon=HORIZON, engine="mujoco").qpos[-1]

    found = jax.jit(jax.vmap(jax.vmap(last, (None, 0)), (0, None)))(stiffness, speeds)
    expected = np.array([[last(k, v) for v in speeds] for k in stiffness])
    np.testing.assert_array_equal(found, expected)
    assert np.abs(found[0] - found[1]).max() > 1e-6


def test_a_rollout_that_diverges_stays_at_its_last_good_state(scene):
    controls = jnp.zeros((HORIZON, scene.model.nu)).at[7, 0].set(jnp.nan)
    trajectory = jax.jit(lambda u: _rollout(scene, jnp.zeros(scene.model.nv), u, engine="mujoco"))(controls)
    assert trajectory.diverged
    assert trajectory.first_bad_step == 7
    assert np.isfinite(trajectory.qpos).all()
    np.testing.assert_array_equal(trajectory.qpos[8:], np.tile(trajectory.qpos[7], (HORIZON - 7, 1)))


def test_zeroth_order_is_the_same_by_either_engine():
    task = mg.tasks.push()
    costs = [
        mg.estimators.zeroth_order(
            task.with_engine(engine).objective(), task.initial_params(), jax.random.key(0), num_samples=4
        )
        for engine in ("mjx", "mujoco")
    ]
    np.testing.assert_allclose(costs[1].value, costs[0].value, atol=1e-6 * np.abs(costs[0].value).max())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"engine": "mujoco", "onset": mg.Onset()}, "in MuJoCo's own motion, got onset: leave it out"),
        ({"engine": "mujoco", "gradient": "slope"}, "got gradient='slope'"),
    ],
)
def test_what_it_cannot_do_is_refused(scene, settings, message):
    with pytest.raises(ValueError, match=message):
        _rollout(scene, jnp.zeros(scene.model.nv), None, horizon=2, **settings)


def test_a_derivative_is_refused(scene):
    def cost(qvel):
        return _rollout(scene, qvel, None, horizon=2, engine="mujoco").qpos.sum()

    with pytest.raises(
        ValueError, match='engine="mujoco" has no derivative: take "mjx", or an estimator of zeroth order'
    ):
        jax.grad(cost)(jnp.zeros(scene.model.nv))
