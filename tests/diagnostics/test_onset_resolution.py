"""Onsets are found where contacts begin, with the speed they begin at, and a threshold that tells right derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjxgrad as mg
from mjxgrad.diagnostics import onset_resolution
from mjxgrad.diagnostics.onset import STEPS_NEEDED

STEP, SPEED, START, HORIZON = 0.002, 2.0, 0.0083, 45
BALL = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0" tolerance="1e-12"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" contype="2" conaffinity="2"/>
    <geom name="shelf" type="plane" pos="0 0 -1" size="1 1 .1"/>
    <body pos="0 0 0.1">
      <joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" contype="3" conaffinity="3" condim="1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def scene():
    return mg.load_scene(BALL)


@pytest.fixture(scope="module")
def fall(scene):
    """Roll out a bounce; with the derivative of its last speed by where it starts, at given width and impedance."""

    def end(height, softness):
        softened = scene.with_softness(softness)
        state = mg.initial_state(softened, qpos=height[None], qvel=jnp.array([-SPEED]))
        trajectory = mg.rollout(softened, state, horizon=HORIZON)
        return trajectory.qvel[-1, 0], trajectory

    def run(height, softness):
        # Forward mode compiles in half the time.
        at, ahead = (height,), (jnp.ones_like(height),)
        _, slope, trajectory = jax.jvp(lambda height: end(height, softness), at, ahead, has_aux=True)
        return trajectory, slope, onset_resolution(scene.with_softness(softness), trajectory)

    return eqx.filter_jit(jax.vmap(run, in_axes=(0, None)))


def _softness(steps, first=0.0):
    """So wide a rise that a ball of this speed takes so many steps across it; as stiff as MuJoCo's default."""
    return mg.Softness(2500.0, 1.0, impedance=(first, 0.95), width=steps * SPEED * STEP, margin=0.0)


# One period of the phase of a step, 4 mm at this speed.
PHASES = START + (np.arange(64) + 0.5) / 64 * SPEED * STEP
# 2ζω₀e with ζ = 1 and e = e⁻²: what a jump from nothing to the whole impedance costs the derivative of the speed (1/s).
UNIT = 2 * 50 * np.exp(-2)


def test_an_onset_has_its_step_its_speed_and_its_number_of_steps(scene, fall):
    _, _, found = fall(PHASES, _softness(0.7))
    floor = next(i for i, pair in enumerate(scene.pairs) if "floor" in pair.names)
    # From 8.3 to 12.3 mm at 4 mm a step: inside after the third step, or after the fourth.
    is_late = PHASES > 3 * SPEED * STEP
    np.testing.assert_array_equal(np.argmax(found.is_onset[..., floor], axis=1), 2 + is_late)
    np.testing.assert_allclose(found.speed[..., floor].max(axis=1), SPEED, rtol=1e-12)
    np.testing.assert_allclose(found.worst[:, floor], 0.7, rtol=1e-9)
    assert np.isinf(found.worst[:, 1 - floor]).all()
    assert (found.num_onsets[:, floor] == 1).all()
    assert (found.num_onsets[:, 1 - floor] == 0).all()


def test_a_rise_within_a_step_is_missed_by_the_share_of_phases_that_step_over_it(fall):
    _, slopes, found = fall(PHASES, _softness(0.2))
    assert not found.is_resolved.all(axis=1).any()
    # 1 − n of all phases are off by as much as a jump makes it; four of 64 stand near the edges of the rise.
    assert np.mean(np.abs(slopes / UNIT + 1) < 0.1) == pytest.approx(0.8, abs=4 / 64)


def test_an_onset_of_the_steps_needed_has_the_right_derivative_in_every_phase(fall):
    _, slopes, found = fall(PHASES, _softness(STEPS_NEEDED))
    assert found.is_resolved.all()
    # The speed after the bounce does not depend on where it began; 0.05 is the largest standard deviation in the table.
    assert np.std(slopes / UNIT) < 0.05
    assert np.abs(slopes / UNIT).max() < 0.1


@pytest.mark.parametrize("first", [0.0, 0.1, 0.5])
def test_the_mean_over_phases_misses_what_begins_with_a_jump_and_nothing_else(fall, first):
    _, slopes, _ = fall(PHASES, _softness(1.0, first))
    # −d₀/d_w; at 50 rad/s a step is a tenth of a radian, which is the error to expect of the unit. A midpoint rule of
    # 64 points is off by less than the spread, 0.6, over 64.
    assert np.mean(slopes) / UNIT == pytest.approx(-first / 0.95, abs=0.01 + 0.1 * first / 0.95)


def test_messages_name_the_pair_and_what_would_resolve_it(fall):
    _, _, jumps = fall(PHASES, _softness(0.5, first=0.9))
    (sentence,) = jumps.messages()
    assert "64 onsets of floor – ball, at up to 2 m/s, are not resolved" in sentence
    assert "begins with a jump, at an impedance of 0.9" in sentence
    assert "0.5 steps of 2 needed" in sentence
    # 2 · 2 m/s · 2 ms.
    assert "width of at least 0.008 m" in sentence
    assert "onset=mg.Onset()" in sentence
    _, _, short = fall(PHASES, _softness(0.5))
    # 2 mm / (2 · 2 m/s).
    assert "time step of at most 0.0005 s" in short.messages()[0]
    _, _, ample = fall(PHASES, _softness(4.0))
    assert ample.messages() == []
    # However wide the rise, a jump before it is not resolved.
    _, _, late = fall(PHASES, _softness(4.0, first=0.9))
    assert "begins with a jump" in late.messages()[0]


def test_a_pair_that_already_touches_has_no_onset(fall):
    _, _, found = fall(np.full(64, -0.001), _softness(1.0))
    assert found.num_onsets.sum() == 0
    assert found.is_resolved.all()


def test_a_rollout_without_pairs_has_no_onsets():
    free = mg.load_scene("<mujoco><worldbody><body><joint/><geom size='.1' pos='.1 0 0'/></body></worldbody></mujoco>")
    found = onset_resolution(free, mg.rollout(free, mg.initial_state(free), horizon=2))
    assert found.is_onset.shape == (2, 0)
    assert found.messages() == []
