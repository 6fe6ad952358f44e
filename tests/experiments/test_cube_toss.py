"""The thrown cube, and what the experiment on it says of its numbers."""

import jax
import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from experiments.cube_toss import Course, Outcome, Point, answer, cube_toss, fastest, verdict

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
