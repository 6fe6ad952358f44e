"""Identification beside mujoco.sysid: both answer alike."""

import pytest

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "optimize"):
    pytest.skip("mujoco[sysid] is not installed", allow_module_level=True)

from experiments.identification_bench import compare, problem  # noqa: E402


def test_both_give_the_same_values_and_intervals():
    """Armature, damping and mass of a joint. Ours ends when 1e-3 of a standard error is left; theirs differences one-sidedly."""
    row = compare(problem(3, 2), runs=1, limit=0)
    difference, values, widths = row.apart
    assert difference < 0.01
    assert values < 1e-3
    assert widths < 1e-3
    assert len(row.theirs) == len(row.again) == len(row.first) == 1
