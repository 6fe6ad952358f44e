"""Identification beside mujoco.sysid: both answer alike, and the line that says who is faster reads the medians."""

import pytest

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "optimize"):
    pytest.skip("mujoco[sysid] is not installed", allow_module_level=True)

from experiments.identification_bench import Row, compare, problem, verdict  # noqa: E402


def test_both_give_the_same_values_and_intervals():
    """Armature, damping and mass of a joint. Ours ends when 1e-3 of a standard error is left; theirs differences one-sidedly."""
    row = compare(problem(3, 2), runs=1, limit=0)
    difference, values, widths = row.apart
    assert difference < 0.01
    assert values < 1e-3
    assert widths < 1e-3
    assert len(row.theirs) == len(row.again) == len(row.first) == 1


def test_where_ours_is_faster_is_told_from_medians():
    """Medians are 2 s for theirs, and 1, 4 and 9 s for ours; in the other problem 2 s and 8 s, whatever the least are."""
    large = Row([2.0, 1.0, 3.0], [1.0, 0.5, 9.0], [4.0, 4.0, 0.1], [9.0], (5, 7), (1e-4, 1e-6, 1e-6))
    small = Row([2.0, 2.0, 9.0], [8.0, 8.0, 0.1], [8.0, 8.0, 0.1], [9.0], (5, 7), (3e-4, 1e-6, 1e-6))
    assert verdict({(30, 100): large, (1, 1): small}) == (
        "Ours is faster, search alone at 30 × 100 (2 times); called again at none; with compiling at none; theirs elsewhere. "
        "Values differ by at most 3e-04 of an interval."
    )
