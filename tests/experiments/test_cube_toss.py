"""The thrown cube, and what the experiment on it says of its numbers."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from experiments.cube_toss import Course, Outcome, Point, answer, cube_toss, fastest, substepped_step, verdict
from mjxgrad.rollouts.state import data_of
from tests.rollouts.test_integration import BALL, HORIZON, RADIUS, RESTITUTION, STEP, thrown

REFERENCE = np.array([0.5, 0.5, 0.5])


def point(method, setting, share, seconds):
    """A point whose single errors are all the same share of the derivative."""
    return Point(method, setting, (1 + share) * REFERENCE, seconds, 10.0, 1000.0, False)


@pytest.fixture(scope="module")
def course():
    points = (
        point("discrete", 2e-3, 0.001, 0.1), point("discrete", 1e-3, 2.0, 0.2), point("discrete", 5e-4, 1.5, 0.4),
        point("slope", 2e-3, 0.1, 0.15), point("slope", 1e-3, 0.015, 0.3), point("slope", 5e-4, 0.004, 0.6),
        point("adaptive", 1e-3, 0.9, 0.1), point("adaptive", 1e-5, 0.8, 0.3),
    )  # fmt: skip
    return Course("default", REFERENCE, points)


def test_a_lucky_coarse_step_is_not_the_fastest(course):
    found = fastest(course)
    assert (found.method, found.setting) == ("slope", 1e-3)


def test_the_verdict_names_the_fastest_and_what_never_is_right(course):
    assert answer(Outcome((course,))) == "MuJoCo's default: 0.3 s, slope at MuJoCo's motion."
    assert verdict(Outcome((course,))) == (
        "With MuJoCo's default contact the first below 2% is slope (time step 0.001 s): 1.5% in 0.3 s of processor time; "
        "adaptive, differentiated stays above 20% at every setting."
    )


def test_the_first_contact_is_that_of_c_mujoco():
    """Until the second edge touches MJX and C make the same contacts; a hundred steps from shortly before impact."""
    task = cube_toss("published", timestep=5e-4)
    start = task.start(-2.0)
    horizon = 140  # 70 ms: impact at 66 ms
    found = jax.jit(lambda state: mg.rollout(task.scene, state, horizon=horizon).qpos[-1])(start)
    model = task.scene.to_mujoco()
    data = mujoco.MjData(model)
    data.qvel[:] = np.asarray(start.qvel)
    mujoco.mj_step(model, data, nstep=horizon)
    assert np.abs(data.qpos[0:3] - [0, -0.007, 0.06]).max() < 0.05
    assert np.allclose(found, data.qpos, atol=1e-9)


@pytest.mark.slow
def test_short_steps_at_events_bring_the_bounce_closer_and_flight_is_untouched():
    scene, heights = mg.load_scene(BALL), RADIUS + jnp.linspace(0, STEP, 9)[:-1]

    def motion(step):
        def throw(height):
            def advance(data, _):
                return step(scene.model, data), data.qpos[0]

            start = data_of(scene, thrown(scene, height), scene.data.ctrl)
            return jax.lax.scan(advance, start, length=HORIZON + 1)[1]

        return np.asarray(jax.jit(jax.vmap(throw))(heights))

    coarse, fine = motion(mg.step), motion(lambda model, data: substepped_step(model, data, num_substeps=16))
    assert np.array_equal(coarse[:, :20], fine[:, :20])

    # Along the start height the outcome is a line and a tooth; the tooth of a step cut in sixteen is much smaller.
    def tooth(values):
        return np.ptp(values[:, -1] + RESTITUTION * np.asarray(heights))

    assert tooth(fine) < tooth(coarse) / 3
