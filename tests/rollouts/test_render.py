"""Drawing: on a machine without OpenGL the refusal is tested in place of the pictures."""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mjxgrad.rollouts.render import RenderingUnavailableError, frames, tile, write_video
from tests.processes import run_python

# A white ball that slides along x, seen from a camera that looks along y: its place in the picture is its place in x.
SLIDER = """
<mujoco>
  <option timestep="0.01"/>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody>
    <camera name="side" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    <body><joint type="slide" axis="1 0 0"/><geom size="0.2" rgba="1 1 1 1"/></body>
  </worldbody>
</mujoco>
"""
TIMESTEP = 0.01


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(SLIDER)


@pytest.fixture(scope="module")
def opengl(model):
    """Skip what needs pictures; that there is a sentence in their place has a test of its own."""
    try:
        frames(model, np.zeros((1, 1)), timestep=TIMESTEP, height=8, width=8)
    except RenderingUnavailableError as error:
        pytest.skip(str(error))


def centres(video):
    """Mean column of the white pixels of each frame, from -1 at the left edge to 1 at the right one."""
    columns = np.linspace(-1, 1, video.shape[2])
    brightness = (video > 200).all(axis=-1).sum(axis=1)
    return (brightness * columns).sum(axis=1) / brightness.sum(axis=1)


@pytest.mark.usefixtures("opengl")
def test_the_picture_follows_the_state(model):
    qpos = np.array([[-0.5], [0.0], [0.5]])
    video = frames(model, qpos, timestep=TIMESTEP, fps=100, height=60, width=80, camera="side")
    left, middle, right = centres(video)
    assert abs(middle) < 0.02
    assert left == pytest.approx(-right, abs=0.02)
    assert right > 0.2


@pytest.mark.usefixtures("opengl")
def test_the_default_view_goes_along_with_what_would_leave_it(model):
    """Twenty metres along the floor end where they began in the picture; a tenth of a metre is seen as a move."""
    far, near = (frames(model, np.array([[0.0], [x]]), timestep=1, fps=1, height=60, width=80) for x in (20.0, 0.1))
    assert_array_equal(far[1], far[0])
    assert abs(centres(near)[1] - centres(near)[0]) > 0.02


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize(("speed", "expected"), [(1.0, 11), (0.5, 21), (2.0, 6)])
def test_speed_sets_the_number_of_frames(model, speed, expected):
    """100 steps of 0.01 s are 1 s, shown at 10 frames per second: 11 frames with the first, at real speed."""
    video = frames(model, np.zeros((101, 1)), timestep=TIMESTEP, fps=10, speed=speed, height=16, width=16)
    assert len(video) == expected


@pytest.mark.usefixtures("opengl")
def test_a_picture_may_be_larger_than_the_scene_says_and_the_scene_is_left_alone(model):
    offscreen = model.vis.global_.offwidth
    video = frames(model, np.zeros((1, 1)), timestep=TIMESTEP, height=8, width=offscreen + 10)
    assert video.shape == (1, 8, offscreen + 10, 3)
    assert model.vis.global_.offwidth == offscreen


@pytest.mark.parametrize(
    ("qpos", "settings", "sentence"),
    [
        (np.zeros((3, 2)), {}, r"qpos must have shape \(states, nq\) = \(at least 1, 1\), got \(3, 2\)"),
        (np.zeros((0, 1)), {}, r"got \(0, 1\)$"),
        (np.array([[0.0], [np.nan]]), {}, "not in state 1"),
        (np.zeros((3, 1)), {"fps": 0.0}, "fps must be positive, got 0.0"),
        (np.zeros((3, 1)), {"speed": -1.0}, "speed must be positive, got -1.0"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_sentence(model, qpos, settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        frames(model, qpos, timestep=TIMESTEP, **settings)


def test_tiles_stand_in_rows_and_the_shorter_video_keeps_its_last_frame():
    short = np.full((1, 20, 40, 3), 50, np.uint8)
    long = np.stack([np.full((20, 40, 3), value, np.uint8) for value in (100, 200)])
    tiled = tile([short, long, short], ["soft", "stiff", "σ = 0.1"], columns=2)
    band = tiled.shape[1] // 2 - 20
    assert tiled.shape == (2, 2 * (band + 20), 80, 3)
    assert band > 0
    assert (tiled[1, band : band + 20, :40] == 50).all()
    assert (tiled[1, band : band + 20, 40:] == 200).all()
    assert (tiled[:, band + 20 :, 40:] == 0).all()
    assert tile([short, long]).shape == (2, 20, 80, 3)
    assert tile([short] * 3).shape == (1, 40, 80, 3)


def test_a_video_is_complete_or_absent(tmp_path):
    video = np.random.default_rng(0).integers(0, 255, (5, 33, 48, 3), dtype=np.uint8)
    write_video(tmp_path / "video.mp4", video, fps=10)
    assert [path.name for path in tmp_path.iterdir()] == ["video.mp4"]
    # An MP4 names its brand in its first box; moov before mdat lets a browser start at once.
    content = (tmp_path / "video.mp4").read_bytes()
    assert content[4:8] == b"ftyp"
    assert content.index(b"moov") < content.index(b"mdat")
    with pytest.raises(OSError, match="absent"):
        write_video(tmp_path / "absent" / "video.mp4", video, fps=10)


def test_a_choice_of_opengl_that_fails_is_named(model, monkeypatch):
    def fail(*_):
        raise AttributeError("module has no attribute 'GLContext'")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(RenderingUnavailableError, match=r"libosmesa6 .* MUJOCO_GL=egl was tried alone: unset it"):
        frames(model, np.zeros((1, model.nq)))


_DRAWS = """
import mjxgrad as mg

scene = mg.load_scene("<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
try:
    mg.render.frames(scene, scene.data.qpos[None])
except mg.render.RenderingUnavailableError as error:
    print(error)
"""


def test_a_choice_of_opengl_that_mujoco_does_not_know_is_told_where_it_is_needed():
    """MuJoCo alone cannot even be imported under it."""
    printed, _ = run_python("-c", _DRAWS, MUJOCO_GL="foo")
    assert printed == "MUJOCO_GL must be egl, glfw, osmesa or unset, got foo\n"


_WITHOUT_OPENGL = """
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("OpenGL", "glfw"):
            raise ImportError(f"there is no {name}")


sys.meta_path.insert(0, Missing())
import mujoco

if hasattr(mujoco, "Renderer"):
    del mujoco.Renderer
"""


def test_all_but_drawing_works_where_there_is_no_opengl_and_the_error_names_the_packages():
    printed, _ = run_python("-c", _WITHOUT_OPENGL + _DRAWS)
    assert all(x in printed for x in ("rendering needs an OpenGL", "libosmesa6", "libegl1"))
