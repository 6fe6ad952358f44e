"""Recorded tosses are read as they were measured, and the search finds what simulated ones were made with."""

import os
import pickle
import sys
from collections import OrderedDict
from types import ModuleType
from unittest import mock

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.config import FOLDER, ExperimentError, load_runs
from experiments.real_tosses import (
    HALF_SIDE,
    NOMINAL,
    RATE,
    SIDE,
    Settings,
    _fit,
    cube,
    errors,
    parameters,
    read_toss,
    recordings,
    replay,
)
from mjxgrad.identification.parameters import write_all

START, VELOCITY, SPIN = np.array([[0.3, -0.2, 0.5], [1.0, -0.5, 0.8], [3.0, -2.0, 5.0]])
GRAVITY = 9.81


def save(path, rows):
    """Write rows as torch.save did before its version 1.6: three pickles of its own, the tensor, the keys, the numbers."""
    torch, utils = ModuleType("torch"), ModuleType("torch._utils")
    torch.DoubleStorage = storage = type("DoubleStorage", (), {"__module__": "torch"})
    utils._rebuild_tensor_v2 = rebuild = lambda *_: None
    rebuild.__module__, rebuild.__qualname__ = "torch._utils", "_rebuild_tensor_v2"

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj):
            return ("storage", storage, "60429056", "cpu", rows.size, None) if isinstance(obj, storage) else None

    class Tensor:
        def __reduce__(self):
            count, width = rows.shape
            return rebuild, (storage(), 0, (1, count, width), (count * width, width, 1), False, OrderedDict())

    # No longer than needed: scipy asks what is loaded as torch.
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}), path.open("wb") as file:
        for part in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}, Tensor(), ["60429056"]):
            Pickler(file, 2).dump(part)
        file.write(np.int64(rows.size).tobytes() + rows.astype("<f8").tobytes())


def rows_of(positions, turns):
    """Rows as ContactNets has them: lengths in half sides, velocities the differences to the row before."""
    velocity = RATE * np.diff(positions, axis=0) / HALF_SIDE
    spin = RATE * (turns[:-1].inv() * turns[1:]).as_rotvec()
    quaternion = turns.as_quat()[1:][:, [3, 0, 1, 2]]
    return np.hstack([positions[1:] / HALF_SIDE, quaternion, velocity, spin, np.zeros((len(spin), 6))])


@pytest.fixture
def flight(tmp_path):
    """A free flight with spin about an axis fixed in the cube, from an oblique orientation; the first row at 1/148 s."""
    times = np.arange(25)[:, None] / RATE
    positions = START + VELOCITY * times - [0, 0, GRAVITY / 2] * times**2
    turns = Rotation.from_rotvec([0.5, 1.0, -0.7]) * Rotation.from_rotvec(SPIN * times)
    save(tmp_path / "7.pt", rows_of(positions, turns))
    return times[1:, 0], read_toss(tmp_path / "7.pt")


def test_a_flight_is_read_in_metres_at_its_own_times(flight):
    times, toss = flight
    place = START + VELOCITY * times[:, None] - [0, 0, GRAVITY / 2] * times[:, None] ** 2
    speed = VELOCITY - [0, 0, GRAVITY] * times[:, None]
    assert toss.number == 7
    np.testing.assert_allclose(toss.qpos[:, :3], place, atol=1e-12)
    np.testing.assert_allclose(toss.qvel[:-1], np.hstack([speed, np.tile(SPIN, (24, 1))])[:-1], atol=1e-10)


def test_mujoco_flies_on_as_recorded(flight):
    """So the velocities are in MuJoCo's frames; the places lag by the h g t / 2 of semi-implicit Euler, 1.3 mm at 1/592 s."""
    times, toss = flight
    course = replay(cube(4, **NOMINAL).mj_model, toss, 4)
    np.testing.assert_allclose(course[:, :2], toss.qpos[:, :2], atol=1e-10)
    np.testing.assert_allclose(course[:, 2], toss.qpos[:, 2] - GRAVITY / 592 / 2 * (times - times[0]), atol=1e-10)
    assert errors(course, toss)[1] < 1e-4


def test_errors_are_those_of_a_known_shift_and_turn(flight):
    _, toss = flight
    turned = Rotation.from_quat(toss.qpos[:, [4, 5, 6, 3]]) * Rotation.from_rotvec([0, 0, np.radians(30)])
    moved = np.hstack([toss.qpos[:, :3] + [0, SIDE / 2, 0], -turned.as_quat()[:, [3, 0, 1, 2]]])
    np.testing.assert_allclose(errors(moved, toss), [0.5, 30.0], rtol=1e-9)


def test_a_file_that_would_run_code_is_refused(tmp_path):
    (tmp_path / "0.pt").write_bytes(pickle.dumps(os.getcwd, 2))
    with pytest.raises(ExperimentError, match="must be a toss of ContactNets as its repository has it: it holds posix"):
        read_toss(tmp_path / "0.pt")


def test_side_and_radius_move_corners_as_a_cube_with_them_has_them():
    wanted = {**NOMINAL, "side": 0.09, "radius": 0.004}
    scene, truth = cube(1, **NOMINAL), cube(1, **wanted)
    for names in (("side", "radius"), ("radius", "side")):
        written = write_all(scene, parameters(scene, names), {name: jnp.array(wanted[name]) for name in names})
        np.testing.assert_allclose(written.model.geom_pos, truth.model.geom_pos, atol=1e-12)
        np.testing.assert_allclose(written.model.geom_size, truth.model.geom_size, atol=1e-12)


@pytest.mark.slow
def test_the_numbers_of_simulated_tosses_come_back(tmp_path):
    """Three tosses of C MuJoCo, recorded as ContactNets records, with 0.05 mm of noise, from a start 20 % off."""
    truth = {"side": 0.1, "radius": 3e-3, "friction": 0.22, "stiffness": 2e4, "damping_ratio": 0.6}
    (run,) = load_runs(str(FOLDER / "real_tosses.toml"), ["num_windows=4", "max_steps=25"])
    assert isinstance(run.settings, Settings)
    model, rng, windows = cube(4, **truth).mj_model, np.random.default_rng(0), []
    for number in range(3):
        data = mujoco.MjData(model)
        data.qpos[:3] = [0, 0, 0.16]
        data.qpos[3:] = Rotation.random(rng=rng).as_quat()
        data.qvel[:] = [*rng.normal(size=2), 0.3, *(4 * rng.normal(size=3))]
        course = []
        for _ in range(90):
            course.append(data.qpos.copy())
            mujoco.mj_step(model, data, nstep=4)
        course = np.array(course)
        turns = Rotation.from_quat(course[:, [4, 5, 6, 3]])
        save(tmp_path / f"{number}.pt", rows_of(course[:, :3] + 5e-5 * rng.normal(size=(90, 3)), turns))
        windows += recordings(read_toss(tmp_path / f"{number}.pt"), run.settings)
    found = _fit(run.settings, tuple(truth), windows, has_onset=True)
    for name, share in {"side": 0.01, "friction": 0.05, "damping_ratio": 0.1, "stiffness": 0.3}.items():
        np.testing.assert_allclose(found.values[name], truth[name], rtol=share, err_msg=name)
