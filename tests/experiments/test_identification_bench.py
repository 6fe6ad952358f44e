"""Identification beside mujoco.sysid: both answer alike."""

import pytest

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "optimize"):
    pytest.skip("mujoco[sysid] is not installed", allow_module_level=True)

import numpy as np  # noqa: E402

from experiments.identification_bench import ROBOTS, compare, problem, recorded  # noqa: E402
from mjxgrad.identification.motions import Motions  # noqa: E402
from mjxgrad.identification.recording import stack  # noqa: E402


def test_both_give_the_same_values_and_intervals():
    """Armature, damping and mass of a joint. Ours ends when 1e-3 of a standard error is left; theirs differences one-sidedly."""
    row = compare(problem(3, 2), runs=1, limit=0)
    difference, values, widths = row.apart
    assert difference < 0.01
    assert values < 1e-3
    assert widths < 1e-3
    assert len(row.theirs) == len(row.again) == len(row.first) == 1


@pytest.mark.parametrize("name", ROBOTS)
def test_both_mean_the_same_numbers_of_a_robot(name):
    """The recordings are made by numbers in a specification; by ours, from the true start, only their noise is left."""
    robot = ROBOTS[name]
    given = recorded(robot, seed=3, count=2)
    motions = Motions(given.scene, given.parameters, delay=None, contact=None)
    windows = stack(given.scene, given.recordings)
    offsets = np.stack([np.array(robot.start) - one.measured["qpos"][0] for one in given.recordings])
    starts = np.concatenate([offsets, np.zeros_like(offsets)], axis=1)[None]
    left = motions.residuals(windows, np.array([list(given.truth.values())]), starts)
    np.testing.assert_allclose(np.sqrt(np.mean(left**2)), 1.0, atol=4 / np.sqrt(2 * left.size))
