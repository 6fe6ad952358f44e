"""C MuJoCo behind `rollout`: the same motion, mapped over starts and controls; what it cannot do is refused."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad._warnings import collected
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
        jax.jit(jax.vmap(lambda v, u, engine=engine: _rollout(scene.with_engine(engine), v, u)))(qvel, controls)
        for engine in ("mjx", "mujoco")
    )
    # Both solve to the file's tolerance, which impacts amplify.
    np.testing.assert_allclose(theirs.qpos, ours.qpos, atol=1e-6)
    np.testing.assert_allclose(theirs.qvel, ours.qvel, atol=1e-4)
    for name in ("ctrl", "diverged", "first_bad_step"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name))
    np.testing.assert_allclose(theirs.final.time, ours.final.time, rtol=1e-12)


def test_a_rollout_that_diverges_stays_at_its_last_good_state(scene):
    controls = jnp.zeros((HORIZON, scene.model.nu)).at[7, 0].set(jnp.nan)
    trajectory = jax.jit(lambda u: _rollout(scene.with_engine("mujoco"), jnp.zeros(scene.model.nv), u))(controls)
    assert trajectory.diverged
    assert trajectory.first_bad_step == 7
    assert np.isfinite(trajectory.qpos).all()
    np.testing.assert_array_equal(trajectory.qpos[8:], np.tile(trajectory.qpos[7], (HORIZON - 7, 1)))


def test_a_policy_is_asked_before_each_step(scene):
    """The controls that it gave, given as numbers, make the same motion."""

    def policy(gain, state):
        return -gain * state.qvel[: scene.model.nu] + 0.3 * jnp.sin(30 * state.time)

    start = mg.initial_state(scene, qvel=0.1 * jnp.arange(scene.model.nv))
    closed = mg.rollout(scene.with_engine("mujoco"), start, policy, 0.5, horizon=HORIZON)
    again = mg.rollout(scene.with_engine("mujoco"), start, closed.ctrl)
    # A solve that starts from another acceleration ends within its tolerance, not at the same bit.
    np.testing.assert_allclose(closed.qpos, again.qpos, atol=1e-7)
    assert np.ptp(closed.ctrl) > 0.1


def test_what_is_given_to_each_step_acts_alike_in_both_engines():
    scene = mg.load_scene(
        """<mujoco><option tolerance="1e-12"/><default><geom condim="1"/></default><worldbody><body mocap="true" pos="0 0 .5">
        <geom size=".05"/></body><body pos="0 0 .4"><freejoint/><geom size=".05" mass=".2"/></body><body pos="1 0 0">
        <joint name="a" type="slide"/><joint name="b" type="slide" axis="1 0 0"/><geom size=".05"/></body></worldbody>
        <equality><joint joint1="a" joint2="b"/></equality></mujoco>"""
    )
    time = np.arange(HORIZON)[:, None]
    inputs = {
        "mocap_pos": np.array([[[0, 0, 0.5]]]) + 1e-3 * time[..., None] * np.array([0.1, 0.05, -1.0]),
        "xfrc_applied": np.where(np.arange(4)[:, None] == 2, np.sin(0.1 * time)[..., None], 0.0) * np.ones(6),
        "qfrc_applied": np.cos(0.2 * time) * np.linspace(0.1, 0.8, 8),
        "eq_active": (time < HORIZON // 2).astype(np.uint8),
    }
    ours, theirs = (
        mg.rollout(scene.with_engine(engine), mg.initial_state(scene), horizon=HORIZON, inputs=inputs).qpos
        for engine in ("mjx", "mujoco")
    )
    np.testing.assert_allclose(theirs, ours, atol=1e-7)  # what the solves leave, and contacts multiply
    still = mg.rollout(scene.with_engine("mujoco"), mg.initial_state(scene), horizon=HORIZON).qpos
    assert np.abs(still - theirs).max() > 1e-2


def test_softness_acts_on_a_scene_that_mjx_lacks():
    """A cylinder dropped onto a box, ten times as stiff as in the file: the motion of a file that says so."""
    xml = """<mujoco><worldbody><geom type="box" size=".2 .2 .1"/><body pos="0 0 .21"><freejoint/>
      <geom type="cylinder" size=".05 .1" {}/></body></worldbody></mujoco>"""
    with pytest.warns(mg.scene.SceneWarning, match="C MuJoCo steps it"):
        scene = mg.load_scene(xml.format(""))
    stiff = scene.with_softness(mg.Softness(stiffness=25e3, damping_ratio=1.0))
    damping = 2 * np.sqrt(25e3)
    model = mujoco.MjModel.from_xml_string(xml.format(f'solref="-25000 {-damping}" priority="1"'))
    np.testing.assert_allclose(stiff.contact_parameters().stiffness, 25e3)
    data = mujoco.MjData(model)
    for qpos in mg.rollout(stiff, mg.initial_state(stiff), horizon=40).qpos[1:]:
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(qpos, data.qpos, atol=1e-9)
    assert np.abs(data.qpos - mg.rollout(scene, mg.initial_state(scene), horizon=40).qpos[-1]).max() > 1e-4


def test_warnings_are_heard_by_the_thread_that_caused_them_until_it_has_done():
    """MuJoCo has one handler for all: without it a warning is written to a file, or calls nothing at all."""
    model, former = mujoco.MjModel.from_xml_path(str(scene_path("servo_arm"))), mujoco.get_mju_user_warning()

    def diverge():
        data = mujoco.MjData(model)
        data.qvel[0] = np.nan
        mujoco.mj_step(model, data)

    with ThreadPoolExecutor(1) as other, collected() as mine:
        with collected() as inner:
            other.submit(diverge).result()
            assert not mine
            assert not inner
        diverge()
        assert len(mine) == 1
    assert mujoco.get_mju_user_warning() is former
