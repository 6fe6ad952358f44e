"""Other ways to step a scene, against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.integration import adaptive_rollout, phase_average, shifted_rollout, substepped_rollout

pytest.importorskip("diffrax")

RADIUS, STEP, HORIZON = 0.05, 2e-3, 100
# A constant impedance of 0.9 and critical damping: the ball comes back with e⁻² of its speed (tests of textbook.bounce).
BALL = f"""
<mujoco>
  <option gravity="0 0 0" timestep="{STEP}"/>
  <worldbody>
    <geom type="plane" size="1 1 .1" solimp="0.9 0.9 0.001"/>
    <body pos="0 0 {RADIUS}">
      <joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{RADIUS}" mass="2" solimp="0.9 0.9 0.001"/>
    </body>
  </worldbody>
</mujoco>
"""
SPINNING = """
<mujoco>
  <option gravity="0 0 0" timestep="0.01"/>
  <worldbody><body><freejoint/><geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody>
</mujoco>
"""
DRIVEN = """
<mujoco>
  <option gravity="0 0 0" timestep="0.1"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""
RESTITUTION = float(np.exp(-2))


@pytest.fixture(scope="module")
def ball():
    return mg.load_scene(BALL)


def thrown(scene, height):
    return mg.initial_state(scene, qpos=jnp.array([height]), qvel=jnp.array([-1.0]))


def closed_form(height):
    """Height at 0.2 s: contact takes 2 t_c = 40 ms at critical damping and constant impedance (facts of textbook.bounce)."""
    bounce = mg.tasks.textbook.Bounce(time_constant=0.02, damping_ratio=1.0)
    return bounce.height(height, HORIZON * STEP)


@pytest.fixture(scope="module")
def adaptive(ball):
    @jax.jit
    @jax.value_and_grad
    def run(height):
        found = adaptive_rollout(ball, thrown(ball, height), [HORIZON * STEP], tolerance=1e-6, max_steps=1024)
        return jnp.where(found.has_failed, jnp.nan, found.qpos[-1, 0])

    return run


@pytest.mark.slow
def test_adaptive_integration_finds_the_bounce_in_closed_form(adaptive):
    height, _ = adaptive(jnp.array(0.05))
    # Errors add up over some 10² steps of 1e-6 and are carried along for 0.1 s.
    assert height == pytest.approx(float(closed_form(0.05)), abs=2e-5)


@pytest.mark.slow
def test_the_difference_quotient_of_adaptive_rollouts_is_the_restitution_and_its_derivative_is_not(adaptive):
    (low, slope), (high, _) = adaptive(jnp.array(0.045)), adaptive(jnp.array(0.055))
    # Two errors of 2e-5 over 0.01.
    assert (high - low) / 0.01 == pytest.approx(-RESTITUTION, abs=4e-3)
    assert abs(slope + RESTITUTION) > 0.5


@pytest.mark.slow
def test_adaptive_integration_turns_a_free_body_about_its_axis_and_keeps_quaternions_normalised():
    scene = mg.load_scene(SPINNING)
    state = mg.initial_state(scene, qvel=jnp.array([1.0, 0, 0, 0, 0, 3.0]))
    found = eqx.filter_jit(adaptive_rollout)(scene, state, jnp.array([0.5, 1.0]), tolerance=1e-9)
    half = 3.0 * np.array([0.5, 1.0]) / 2
    assert np.allclose(found.qpos[:, 3:], np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1), atol=1e-7)
    assert np.allclose(found.qpos[:, 0], [0.5, 1.0], atol=1e-9)
    assert not bool(found.has_failed)


@pytest.mark.slow
def test_steps_that_run_out_are_flagged(ball):
    found = eqx.filter_jit(adaptive_rollout)(ball, thrown(ball, 0.05), jnp.array([0.2]), tolerance=1e-8, max_steps=10)
    assert bool(found.has_failed)


@pytest.mark.slow
def test_a_shift_by_a_whole_step_is_none(ball):
    whole = eqx.filter_jit(mg.rollout)(ball, thrown(ball, 0.05), horizon=HORIZON)
    shifted = eqx.filter_jit(shifted_rollout)(ball, thrown(ball, 0.05), phase=jnp.array(1.0), horizon=HORIZON)
    assert np.allclose(shifted.qpos[:-1], whole.qpos, atol=1e-12)
    assert np.allclose(shifted.qpos[-1], whole.qpos[-1], atol=1e-12)


def test_shifted_controls_act_over_the_intervals_that_they_were_given_for():
    scene = mg.load_scene(DRIVEN)
    controls = jnp.array([[4.0], [-2.0], [6.0]])
    end = eqx.filter_jit(lambda phase: shifted_rollout(scene, mg.initial_state(scene), controls, phase=phase))
    found = end(jnp.array(0.3))
    # A mass of 2 kg: velocities are sums of force times time over 2. After 0.03 s, 0.13 s, 0.23 s and 0.3 s.
    assert np.allclose(found.qvel[1:, 0], [0.06, (0.4 - 0.06) / 2, (0.4 - 0.2 + 0.18) / 2, (0.4 - 0.2 + 0.6) / 2])


@pytest.mark.slow
def test_the_mean_over_phases_removes_the_sawtooth(ball):
    heights = RADIUS + jnp.linspace(0, STEP, 17)[:-1]  # one whole tooth at 1 m/s

    def outcome(height, phase):
        return shifted_rollout(ball, thrown(ball, height), phase=phase, horizon=HORIZON).qpos[-1, 0]

    single = jax.jit(jax.vmap(lambda z: outcome(z, 1.0)))(heights)
    mean = jax.jit(jax.vmap(phase_average(outcome, 8)))(heights)

    def deviation(values):
        line = np.polyval(np.polyfit(heights, values, 1), heights)
        slope = np.polyfit(heights, values, 1)[0]
        return np.abs(values - line).max(), slope

    tooth, _ = deviation(np.asarray(single))
    rest, slope = deviation(np.asarray(mean))
    assert rest < tooth / 4
    assert slope == pytest.approx(-RESTITUTION, abs=0.06)


def test_phases_moved_by_a_key_average_to_the_same_grid_shifted(key):
    phases = []
    phase_average(lambda phase: phases.append(phase) or phase, 4, key)
    mean = phase_average(lambda phase: phase, 4, key)()
    assert 0.375 <= float(mean) <= 0.625  # (0 + 1 + 2 + 3)/16 and as much later
    assert float(phase_average(lambda phase: phase, 4)()) == pytest.approx(0.5)


@pytest.mark.slow
def test_short_steps_at_events_bring_the_bounce_closer_and_flight_is_untouched(ball):
    heights = RADIUS + jnp.linspace(0, STEP, 9)[:-1]

    def ends(roll):
        return jax.jit(jax.vmap(lambda z: roll(ball, thrown(ball, z), horizon=HORIZON).qpos[:, 0]))(heights)

    coarse = np.asarray(ends(mg.rollout))
    fine = np.asarray(ends(lambda *args, **kw: substepped_rollout(*args, num_substeps=16, **kw)))
    assert np.array_equal(coarse[:, :20], fine[:, :20])
    # Along the start height the outcome is a line and a tooth; the tooth of a step cut in sixteen is much smaller.
    slope = -RESTITUTION

    def tooth(values):
        return np.ptp(values[:, -1] - slope * np.asarray(heights))

    assert tooth(fine) < tooth(coarse) / 3


def test_what_has_no_meaning_is_refused(ball):
    state = thrown(ball, 0.05)
    with pytest.raises(ValueError, match="num_substeps must be at least 2"):
        substepped_rollout(ball, state, num_substeps=1, horizon=2)
    with pytest.raises(ValueError, match="num_phases must be at least 1"):
        phase_average(lambda phase: phase, 0)
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        shifted_rollout(ball, state, phase=0.5)
    with pytest.raises(ValueError, match="tolerance"):
        adaptive_rollout(ball, state, [0.1], tolerance=0.0)
    with pytest.raises(ValueError, match="times must increase"):
        adaptive_rollout(ball, state, [0.1, 0.1])
