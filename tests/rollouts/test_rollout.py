"""Rollouts: what is kept, what is flagged, what is refused."""

import dataclasses
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.rollouts.rollout import sequence_of
from mjxgrad.scene import SceneWarning

PUSHED = """<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody><geom type="plane" size="1 1 1"/>
  <body pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <geom size=".1" mass="2"/></body></worldbody>
  <actuator><motor joint="x" gear="3"/></actuator></mujoco>"""
H, MASS, GEAR, STEPS = 0.01, 2.0, 3.0, 6


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(PUSHED)


@pytest.fixture(scope="module")
def roll(scene):
    """Roll out from rest; one compilation serves most tests."""
    return jax.jit(lambda controls, noise: mg.rollout(scene, mg.initial_state(scene), controls, noise=noise))


@pytest.fixture
def controls():
    return jnp.array([[0.5], [-1.0], [2.0], [0.0], [1.0], [3.0]])


def _positions(forces):
    """Semi-implicit Euler in closed form: v_k = h Σ f/m, x_k = h Σ v."""
    velocity = np.cumsum(H * GEAR * np.asarray(forces) / MASS)
    return np.concatenate([[0], np.cumsum(H * velocity)])


@pytest.mark.parametrize(
    ("shape", "horizon", "told"),
    [
        ((2, 3), None, "shape (horizon, 2), got shape (2, 3): if its rows are those of actuators, transpose it"),
        ((2, 3), 3, "shape (3, 2), got shape (2, 3): if its rows are those of actuators, transpose it"),
        ((2, 3), 2, "shape (2, 2), got shape (2, 3)"),
        ((3, 3), None, "shape (horizon, 2), got shape (3, 3)"),
    ],
)
def test_transposing_is_proposed_where_it_would_fit(shape, horizon, told):
    with pytest.raises(ValueError, match=f"{re.escape(told)}$"):
        sequence_of(jnp.zeros(shape), None, horizon, 2)


def test_a_trajectory_is_shown_with_the_numbers_that_are_known(scene, controls):
    """Six steps of 0.01 s; what pairs a slope follows is an engine's own. Traced numbers have a form alone."""
    shown = []

    @jax.jit
    def rolled(u):
        course = mg.rollout(scene, mg.initial_state(scene), u, measure_growth=True)
        shown.append(repr(course))
        return course

    course = rolled(controls)
    shown.append(repr(course))
    for name, value in {"diverged": "False", "first_bad_step": "-1", "crowded": "0", "time": "0.06"}.items():
        assert f"{name}={value}," in shown[1]
        assert f"{name}={value}," not in shown[0]
    assert f"growth={float(course.growth):.4g}," in shown[1]
    assert "diverged=bool[]," in shown[0]
    assert "qpos=f64[7,2]," in shown[1]
    assert "f64[2]" not in shown[1]  # the last state's vectors are short, and shown as numbers
    last = [f"{x:.4g}" for x in course.final.qpos.tolist()]
    assert f"qpos=[{' '.join(last)}]," in shown[1]
    long = mg.State(*map(jnp.zeros, (30, 30, 0, (), 30)))
    assert f"f64[30] [{'0 ' * 3}... {'0 ' * 2}0]," in repr(long)
    stepped = scene.with_engine("mujoco")
    assert "pairs" not in repr(mg.rollout(stepped, mg.initial_state(stepped), controls))


def test_states_before_each_step_and_after_the_last_are_those_of_controls_and_noise(roll, controls):
    noise = jnp.arange(6.0)[:, None]
    trajectory = roll(controls, noise)
    np.testing.assert_allclose(trajectory.ctrl, controls + noise)
    np.testing.assert_allclose(trajectory.qpos[:, 0], _positions((controls + noise)[:, 0]), atol=1e-14)
    np.testing.assert_allclose(trajectory.final.qpos, trajectory.qpos[-1])
    assert trajectory.first_bad_step == -1


def test_a_policy_sees_the_present_state(scene):
    """U = -k x: the position follows the recursion of the same feedback."""
    start = mg.initial_state(scene, qpos=jnp.array([0.4, 0.0]))
    trajectory = mg.rollout(scene, start, lambda k, state: -k * state.qpos[:1], 5.0, horizon=STEPS)
    x, v = 0.4, 0.0
    for k in range(STEPS):
        np.testing.assert_allclose(trajectory.qpos[k, 0], x, atol=1e-14)
        v += H * GEAR * (-5.0 * x) / MASS
        x += H * v


def test_observations_belong_to_their_state(scene, controls):
    """The body's world position, which MuJoCo computes from qpos, is that of the state before each step."""

    @jax.jit
    def observed(controls):
        return mg.rollout(
            scene, mg.initial_state(scene), controls, observe=lambda model, data: (data.xpos[1], data.qpos, data.time)
        )

    trajectory = observed(controls)
    position, qpos, time = trajectory.observations
    np.testing.assert_allclose(position[:, 0], trajectory.qpos[:, 0], atol=1e-14)
    np.testing.assert_allclose(qpos, trajectory.qpos)
    np.testing.assert_allclose(time, H * np.arange(STEPS + 1), atol=1e-14)


@pytest.mark.parametrize("checkpoint", [True, False])
def test_gradient_of_the_end_is_the_closed_form(scene, controls, checkpoint):
    """dx_T/du_k = h² gear/m (T - k)."""

    def end(u):
        return mg.rollout(scene, mg.initial_state(scene), u, checkpoint=checkpoint).final.qpos[0]

    expected = H**2 * GEAR / MASS * (STEPS - np.arange(STEPS))
    np.testing.assert_allclose(jax.jit(jax.grad(end))(controls)[:, 0], expected, rtol=1e-12)


@pytest.mark.slow
def test_checkpointing_keeps_a_fraction_of_the_memory():
    """A hundred contact steps: without it every intermediate number of every step is kept."""
    scene = mg.load_scene(PUSHED.replace('gravity="0 0 0"', ""))

    def memory(checkpoint):
        def end(u):
            start = mg.initial_state(scene, qpos=jnp.array([0.0, -0.9]))
            return mg.rollout(scene, start, u, checkpoint=checkpoint).final.qpos[0]

        compiled = jax.jit(jax.grad(end)).lower(jnp.zeros((100, 1))).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert memory(True) * 5 < memory(False)


def test_divergence_is_flagged_where_it_happens_and_does_not_spread(roll, controls):
    """A control that is NaN in step 2 under jit: the state stays at that of step 2."""
    trajectory = roll(controls.at[2, 0].set(jnp.nan), jnp.zeros_like(controls))
    assert trajectory.diverged
    assert trajectory.first_bad_step == 2
    expected = _positions(controls[:, 0])
    np.testing.assert_allclose(trajectory.qpos[:, 0], [*expected[:3], *[expected[2]] * 4], atol=1e-14)


def test_a_runaway_velocity_is_a_divergence(roll, controls):
    trajectory = roll(controls.at[3, 0].set(1e9), jnp.zeros_like(controls))
    assert trajectory.first_bad_step == 3
    assert jnp.isfinite(trajectory.qvel).all()


def test_one_member_of_a_batch_may_diverge_alone(roll, controls):
    batch = jnp.stack([controls, controls.at[0, 0].set(jnp.inf)])
    trajectory = jax.vmap(roll)(batch, jnp.zeros_like(batch))
    np.testing.assert_array_equal(trajectory.diverged, [False, True])
    np.testing.assert_allclose(trajectory.qpos[0, :, 0], _positions(controls[:, 0]), atol=1e-14)


def test_a_rollout_goes_on_where_another_ended(scene, roll, controls):
    whole = roll(controls, jnp.zeros_like(controls))
    half = mg.rollout(scene, mg.initial_state(scene), controls[:3])
    rest = mg.rollout(scene, half.final, controls[3:])
    np.testing.assert_allclose(rest.qpos, whole.qpos[3:], atol=1e-14)


@pytest.mark.parametrize("stiffness", [jnp.nan, -1e3, 0.0])
def test_a_contact_without_a_stiffness_is_flagged_where_only_the_program_knows_it(scene, stiffness):
    """Outside of jit it is refused; inside the ball would fall through the floor in silence."""

    @jax.jit
    def land(stiffness):
        softer = scene.with_softness(mg.Softness(stiffness=stiffness))
        return mg.rollout(softer, mg.initial_state(scene), horizon=2)

    assert bool(land(stiffness).diverged)
    assert not bool(land(1e3).diverged)


_POSED = """<mujoco><compiler angle="radian"/><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body pos="0 0 {height}"><freejoint name="root"/><geom name="trunk" size=".1"/>
    <body><joint name="calf" axis="0 1 0" range="-2.7 -.6" limited="true"/><geom size=".02" pos="0 0 .2"/></body></body>
  </worldbody>
  <keyframe><key name="home" qpos="0 0 .3 1 0 0 0 -1" qvel="1 0 0 0 0 0 0"/><key qpos="0 0 .4 1 0 0 0 -1"/></keyframe></mujoco>"""


def test_a_pose_of_the_file_that_is_no_start_is_said_and_its_key_frames_are_taken():
    """The ball of 0.1 m begins at 0.02 m above the floor: 80 mm deep. The calf is at 0 rad, beyond its range."""
    scene = mg.load_scene(_POSED.format(height=0.02))
    with pytest.warns(SceneWarning) as said:
        mg.initial_state(scene)
    texts = [str(one.message) for one in said]
    assert any("calf begins at 0 rad" in text for text in texts)
    assert any("trunk in floor begins 80 mm deep" in text for text in texts)
    with pytest.warns(SceneWarning, match="trunk in floor begins 50 mm deep"):
        mg.initial_state(scene, qpos=[0, 0, 0.05, 1, 0, 0, 0, -1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        home, second = mg.initial_state(scene, keyframe="home"), mg.initial_state(scene, keyframe=1)
        mg.initial_state(scene, qvel=jnp.zeros(7), keyframe="home")
    assert (home.qpos[2], home.qvel[0], second.qpos[2]) == (0.3, 1.0, 0.4)
    for asked, said in (("hom", r"one of \['home', 1\] in this scene, got 'hom'"), (2, "got 2")):
        with pytest.raises(ValueError, match=said):
            mg.initial_state(scene, keyframe=asked)


def test_a_start_of_fewer_digits_moves_in_the_scenes_precision():
    by_c = mg.load_scene(PUSHED, engine="mujoco")
    start = mg.initial_state(by_c, qpos=np.array([1.0, 0.0]), qvel=np.array([0.0, 2.0]))
    for kind in (jnp.float16, jnp.float32):
        given = dataclasses.replace(start, qpos=start.qpos.astype(kind), qvel=start.qvel.astype(kind))
        found = mg.rollout(by_c, given, horizon=STEPS)
        np.testing.assert_allclose(found.qpos[-1], [1.0, H * 2 * STEPS], rtol=1e-14)  # three steps' rounding
        assert found.qpos.dtype == start.qpos.dtype


def test_no_double_precision_crosses_a_callback_whole():
    """XLA calls back in threads of its own, which do not see `jax.enable_x64` as a context: JAX would round there."""
    by_c = mg.load_scene(PUSHED, engine="mujoco")
    slope = jax.grad(lambda u: mg.rollout(by_c, mg.initial_state(by_c), u).qpos[-1, 0])
    lines = jax.jit(slope).lower(jnp.zeros((2, 1))).as_text().splitlines()
    called = [line for line in lines if "callback" in line]
    assert called
    assert not any("xf64>" in line or "xi64>" in line for line in called)


def test_a_control_is_named_by_its_actuator_which_may_have_several():
    scene = mg.load_scene(
        """<mujoco><worldbody><body><joint name="h" damping=".1"/><geom pos=".3 0 0" size=".1"/></body></worldbody><actuator>
        <pid joint="h" kp="5" kv=".3"/><motor name="m" joint="h" ctrlrange="-1 1"/></actuator></mujoco>""",
        engine="mujoco",
    )
    with pytest.warns(SceneWarning, match="a control of actuator m is 2 in step 0"):
        mg.rollout(scene, mg.initial_state(scene), jnp.full((1, 3), 2.0))
