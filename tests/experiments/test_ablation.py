"""The variants that an ablation compares are what they say, and its words follow from its numbers."""

import dataclasses

import mujoco
import numpy as np
import pytest

import mjxgrad as mg
from experiments.ablation.measure import (
    EVERYTHING,
    FUSED,
    NEEDED,
    RENDERING,
    Cost,
    record,
    scene_path,
    segments,
    variants,
)


@pytest.fixture(scope="module")
def recorded():
    scene = mg.load_scene(scene_path("reacher"), keep_everything=True)
    return record(scene, num_rollouts=2, duration=0.4, least_steps=1, seed=0)


def test_a_group_deletes_what_it_says_and_no_inertia(recorded):
    found = {variant.name: variant.scene.mj_model for variant in variants(scene_path("reacher"), recorded)}
    assert {EVERYTHING, RENDERING, FUSED, NEEDED} <= found.keys()
    assert found[EVERYTHING].ngeom == 10
    assert found[RENDERING].ngeom == 0
    assert found[FUSED].nbody == found[EVERYTHING].nbody - 1
    accelerations = {}
    for name, model in found.items():
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = recorded.qpos[0, 5], recorded.qvel[0, 5]
        mujoco.mj_forward(model, data)
        accelerations[name] = data.qacc
    for name in (RENDERING, FUSED, NEEDED):
        # Inertias pass through one more rotation of frames.
        np.testing.assert_allclose(accelerations[name], accelerations[EVERYTHING], rtol=1e-9)


def test_starts_are_recorded_states_with_the_controls_that_followed(recorded):
    qpos, qvel, controls = segments(recorded, batch=5, horizon=7, seed=1)
    for position, velocity, follow in zip(qpos, qvel, controls, strict=True):
        i, t = np.argwhere((np.asarray(recorded.qpos) == position).all(axis=-1))[0]
        np.testing.assert_array_equal(recorded.qvel[i, t], velocity)
        np.testing.assert_array_equal(recorded.ctrl[i, t : t + 7], follow)


def test_a_long_time_step_leaves_steps_enough_to_start_from():
    scene = mg.load_scene(scene_path("reacher"), keep_everything=True)
    found = record(scene, num_rollouts=1, duration=0.02, least_steps=14, seed=0)
    qpos, _, _ = segments(found, batch=3, horizon=7, seed=0)
    assert found.ctrl.shape[1] == 14
    assert len(qpos) == 3


def test_a_difference_is_called_so_only_beyond_what_rounding_makes():
    seconds = np.array([1.0, 2.0, 4.0])
    cost = Cost(
        seconds=seconds / 2, base_seconds=seconds, compile_seconds=1.0, base_compile_seconds=2.0, flops=1.0, base_flops=2.0,
        is_same_program=False, difference=0.0, rounding=1e-12, scale=10.0,
    )  # fmt: skip
    assert cost.ratio == (0.5, 0.5, 0.5), "by turns, so that load that all meet alike cancels"
    assert cost.verdict == "equal"
    assert dataclasses.replace(cost, difference=5e-11).verdict == "to rounding"
    assert dataclasses.replace(cost, difference=5e-9).verdict == "differs by 5.0e-10"
    assert dataclasses.replace(cost, is_same_program=True).verdict == "same program"
