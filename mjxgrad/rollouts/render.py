"""Offscreen rendering of trajectories to frames and video."""

import copy
import functools
import importlib
import math
import os
import platform
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Array, Float, UInt8

from mjxgrad._arrays import instance, positive, real, whole
from mjxgrad._programs import is_traced
from mjxgrad._text import write
from mjxgrad.batched.device import fits
from mjxgrad.scene import Scene
from mjxgrad.stepping.rows import index_of

Number = int | float
# (frames, height, width, 3)
Frames = UInt8[np.ndarray, "_ _ _ 3"]


class RenderingUnavailableError(RuntimeError):
    """No OpenGL renders without a display; the message names the package that provides one."""


def frames(
    scene: Scene | mujoco.MjModel,
    qpos: Float[np.ndarray, "states nq"] | Float[Array, "states nq"],
    *,
    timestep: Number | None = None,
    fps: Number = 30.0,
    speed: Number = 1.0,
    height: int = 360,
    width: int = 640,
    camera: str | int | mujoco.MjvCamera | None = None,
) -> Frames:
    r"""Return frames of a trajectory at the frame times of a video.

    Frame $i$ shows time $i \cdot$ `speed` / `fps`, by the nearest state: states are close in time, and the mean of
    two quaternions is not the orientation between them.

    Args:
        scene: the scene, drawn by its complete C model; or a C model.
        qpos: positions, one row per `timestep`, the first at time zero.
        timestep: simulated time between two states, in s; None is the model's own.
        fps: frames per second of the video.
        speed: simulated over shown time; 0.25 is four times slower than real.
        height: height in pixels.
        width: width in pixels.
        camera: name, number or free camera; None is MuJoCo's free camera at the scene's own default view, which goes along
            with a body that would leave it.

    Raises:
        ValueError: if `qpos` has no state, does not fit the model or is not finite, if a number is not positive, or
            if there is no such camera.
        RenderingUnavailableError: if there is no OpenGL.
    """
    mj_model = scene.mj_model if isinstance(scene, Scene) else scene
    instance("scene", mj_model, mujoco.MjModel, "of mg.load_scene, or a mujoco.MjModel")
    if hasattr(qpos, "qpos"):
        raise ValueError(f"qpos must be positions, got a {type(qpos).__name__.lower()}: give its .qpos")
    height, width = whole("height", height, None), whole("width", width, None)
    if timestep is None:
        timestep = float(scene.model.opt.timestep if isinstance(scene, Scene) else scene.opt.timestep)
    if is_traced(qpos):
        raise ValueError("frames must be drawn outside of jax.jit and jax.vmap: return qpos, and draw it then")
    positions = np.asarray(real("qpos", qpos), dtype=np.float64)
    _check(mj_model, positions, timestep=timestep, fps=fps, speed=speed, height=height, width=width)
    if isinstance(camera, str):
        index_of(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, camera)  # refuses an unknown one
    elif not isinstance(camera, mujoco.MjvCamera | None) and whole("camera", camera, -1) >= mj_model.ncam:
        raise ValueError(f"camera must be below {mj_model.ncam}, or -1 for the free camera, got {camera}")
    mj_model = copy.copy(mj_model)
    mj_model.vis.global_.offheight = max(height, mj_model.vis.global_.offheight)
    mj_model.vis.global_.offwidth = max(width, mj_model.vis.global_.offwidth)
    data = mujoco.MjData(mj_model)
    last, states_per_frame = len(positions) - 1, speed / fps / timestep
    # The last state counts as reached despite rounding in its time.
    count = int(last / states_per_frame + 1e-6) + 1
    fits(f"{count} frames", 3.0 * count * height * width, "less fps, a higher speed, or smaller ones", is_on_host=True)
    shown = np.arange(count)
    nearest = np.minimum(np.rint(shown * states_per_frame).astype(int), last)
    view, drawn = mujoco.MjvCamera(), []
    mujoco.mjv_defaultFreeCamera(mj_model, view)
    moves = _moves(mj_model, data, positions[nearest]) if camera is None else np.zeros((len(nearest), 3))
    first = view.lookat.copy()
    with _renderer(mj_model, height, width) as renderer:
        for state, move in zip(nearest, moves, strict=True):
            data.qpos[:] = positions[state]
            mujoco.mj_fwdPosition(mj_model, data)
            view.lookat = first + move
            renderer.update_scene(data, view if camera is None else camera)
            drawn.append(renderer.render())
    return np.stack(drawn)


def _moves(
    mj_model: mujoco.MjModel, data: mujoco.MjData, positions: Float[np.ndarray, "frames nq"]
) -> Float[np.ndarray, "frames 3"]:
    """Return how far the body that goes farthest has gone along the floor; zero if it stays within the scene's extent."""
    places = []
    for data.qpos[:] in positions:
        mujoco.mj_kinematics(mj_model, data)
        places.append(data.xpos.copy())
    gone = np.stack(places) - places[0]
    gone[..., 2] = 0.0
    farthest = np.linalg.norm(gone, axis=-1).max(axis=0).argmax()
    moves = gone[:, farthest]
    return moves if np.linalg.norm(moves, axis=-1).max() > mj_model.stat.extent else np.zeros_like(moves)


def tile(videos: Sequence[Frames], captions: Sequence[str] = (), *, columns: int | None = None) -> Frames:
    """Return videos of one size side by side, each under its caption; one that ends early keeps its last frame.

    They stand in rows of so many columns, by default in a square or one column wider. Captions need matplotlib.

    Raises:
        ValueError: if there is no video, captions are fewer or more, or sizes differ.
    """
    videos = [np.asarray(video) for video in videos]
    if not videos or len({video.shape[1:] for video in videos}) > 1 or any(video.ndim != 4 for video in videos):
        sizes = ", ".join(str(video.shape) for video in videos) or "none"
        raise ValueError(f"videos must have one size, each of shape (frames, height, width, 3), got {sizes}")
    if captions and len(captions) != len(videos):
        raise ValueError(f"captions must be {len(videos)}, one for each video, got {len(captions)}")
    columns = math.ceil(math.sqrt(len(videos))) if columns is None else whole("columns", columns)
    length = max(map(len, videos))
    cells = [video[np.minimum(np.arange(length), len(video) - 1)] for video in videos]
    cells = [_captioned(*both) for both in zip(cells, captions, strict=True)] if captions else cells
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    rows = [np.concatenate(cells[i : i + columns], axis=2) for i in range(0, len(cells), columns)]
    return np.concatenate(rows, axis=1)


def _captioned(video: Frames, caption: str) -> Frames:
    """Put a band with a caption above every frame."""
    # Pillow's own font lacks Greek letters; matplotlib brings one that has them, and Pillow.
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    width = video.shape[2]
    size = max(11, width // 28)
    band = Image.new("RGB", (width, 2 * size), (24, 28, 36))
    draw = ImageDraw.Draw(band)
    font = ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)
    draw.text((width / 2, size), caption, font=font, fill=(238, 240, 244), anchor="mm")
    return np.concatenate([np.broadcast_to(np.asarray(band), (len(video), *np.asarray(band).shape)), video], axis=1)


def write_video(path: str | Path, video: Frames, *, fps: Number = 30.0) -> None:
    """Write frames as H.264 in MP4, with the ffmpeg of `imageio_ffmpeg`.

    The file appears at its place, in an existing folder, once it is complete. H.264 refuses an odd last row, so it is left out.

    Raises:
        ValueError: if the video has no frames, or is neither of bytes nor of floats from 0 to 1.
        OSError: if the file cannot be written.
        RuntimeError: if ffmpeg fails, or is not installed.
    """
    # Imported here, since mediapy imports IPython, and drawing needs neither.
    try:
        import imageio_ffmpeg
        import mediapy
    except ImportError as error:
        raise RuntimeError(f"writing a video needs {error.name}: pip install 'mjxgrad[render]'") from error

    instance("path", path, str | os.PathLike, "the path of a file")
    try:
        path, video = Path(path), np.asarray(video)
    except ValueError:  # frames of different sizes
        raise ValueError("video must have frames of one size, of shape (frames, height, width, 3)") from None
    positive("fps", fps)
    if path.suffix.lower() != ".mp4" or path.is_dir():
        raise ValueError(f"path must be of a file that ends in .mp4, got {path}")
    if video.ndim != 4 or not len(video) or video.shape[3] != 3:
        raise ValueError(f"video must have shape (frames, height, width, 3), got {video.shape}")
    is_real = np.issubdtype(video.dtype, np.floating)
    if video.dtype != np.uint8 and not (is_real and ((video >= 0) & (video <= 1)).all()):
        given = f"{video.dtype} from {video.min():g} to {video.max():g}"
        raise ValueError(f"video must be uint8, as mg.render.frames gives, or floats from 0 to 1, got {given}")
    if min(video.shape[1:3]) < 2:
        raise ValueError(f"video must have two rows and two columns at least, got shape {video.shape}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"path must be in an existing folder, got {path}")
    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    # Compressed to memory: a full disk then raises Python's own OSError, not a page of ffmpeg's output.
    even = video[:, : video.shape[1] // 2 * 2, : video.shape[2] // 2 * 2]
    # The index at the front lets a browser start before all is read.
    write(path, mediapy.compress_video(even, codec="h264", fps=fps, crf=23, ffmpeg_args="-movflags +faststart"))


def _check(mj_model: mujoco.MjModel, positions: np.ndarray, **numbers: Number) -> None:
    for name, value in numbers.items():
        positive(name, value)
    if positions.ndim != 2 or positions.shape[1] != mj_model.nq or not len(positions):
        is_batch = positions.ndim == 3 and positions.shape[2] == mj_model.nq
        remedy = (
            ": draw one motion at a time, such as qpos[0]; mg.render.tile puts them side by side" if is_batch else ""
        )
        wanted = f"shape (states, nq) = (at least 1, {mj_model.nq})"
        raise ValueError(f"qpos must have {wanted}, got {positions.shape}{remedy}")
    if not np.isfinite(positions).all():
        bad = int(np.flatnonzero(~np.isfinite(positions).all(axis=1))[0])
        raise ValueError(f"qpos must be finite, got a value that is not in state {bad}; draw the states before it")


# A broken driver may end the process that tries it, so a subprocess does.
_PROBE = """
import mujoco
with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8) as renderer:
    renderer.render()
print("rendered")
"""


@functools.cache
def _choose_opengl() -> None:
    """Choose EGL or OSMesa, whichever works, if none is chosen and there is no display."""
    chosen = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
    if chosen or platform.system() != "Linux":
        return
    for name in ("egl", "osmesa"):
        environment = {**os.environ, "MUJOCO_GL": name}
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False, cwd=tempfile.gettempdir()
        )
        if b"rendered" in probe.stdout:
            # MuJoCo chose during its import; trying its choice first would prevent the others in this process.
            context = importlib.import_module(f"mujoco.{name}").GLContext
            importlib.import_module("mujoco.rendering.classic.gl_context").GLContext = context
            return


def _renderer(mj_model: mujoco.MjModel, height: int, width: int) -> "mujoco.Renderer":
    try:
        _choose_opengl()
        with warnings.catch_warnings():
            # glfw warns before it raises.
            warnings.simplefilter("ignore")
            return mujoco.Renderer(mj_model, height, width)
    # MuJoCo, PyOpenGL, glfw and the drivers raise errors without a common class.
    except Exception as error:
        reason = str(error).partition(",")[0] or type(error).__name__
        if "framebuffer" in reason.lower():
            raise ValueError(f"height and width must be no more than OpenGL draws, got {height} and {width}") from None
        chosen = os.environ.get("MUJOCO_GL", "")
        if chosen and chosen.lower().strip() not in ("egl", "glfw", "osmesa"):
            raise RenderingUnavailableError(f"MUJOCO_GL must be egl, glfw, osmesa or unset, got {chosen}") from None
        alone = f" MUJOCO_GL={chosen} was tried alone: unset it and the others are, too." if chosen else ""
        raise RenderingUnavailableError(
            "rendering needs an OpenGL that works without a display, and none was found: install libosmesa6 (draws on "
            f"the processor) or libegl1 (with a GPU's driver); MuJoCo said: {reason}.{alone}"
        ) from error
