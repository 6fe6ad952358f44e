"""The video of a report."""

import copy
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from experiments.settings import VideoSettings
from experiments.workspace import Workspace
from mjxgrad.rollouts.render import RenderingUnavailableError, frames, write_video

FILE = "video.mp4"


def film(
    workspace: Workspace,
    motions: Sequence[tuple[mujoco.MjModel, np.ndarray]],
    look: VideoSettings,
    *,
    camera: str,
    caption: str,
    titles: Sequence[str] = (),
    columns: int = 1,
    timestep: float | None = None,
) -> tuple[str | None, str]:
    """Draw motions side by side, each a model and its positions over time.

    Several have titles and stand in columns. The time between positions (s) is the model's own if it is not given. Gives the
    file in the output folder and its caption; without OpenGL None and the reason.
    """
    clips = []
    try:
        with workspace.stage("video", "motions", len(motions)) as advance_to:
            for mj_model, qpos in motions:
                clips.append(
                    frames(
                        mj_model, np.asarray(qpos), timestep=timestep or mj_model.opt.timestep, fps=look.fps, speed=look.speed,
                        width=look.width, height=look.height, camera=camera,
                    )
                )  # fmt: skip
                advance_to(len(clips))
            pictures = tile(clips, titles, columns=columns) if titles else clips[0]
            write_video(workspace.folder / FILE, pictures, fps=look.fps)
    except RenderingUnavailableError as error:
        return None, str(error)
    return FILE, caption


def shown_speed(speed: float) -> str:
    """Name the speed of a video."""
    return "at real speed" if speed == 1 else f"at {speed:g} of real speed"


def with_coarse_shadows(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy a model with coarser shadows: without a GPU fine ones double the time of a frame, and nobody sees them."""
    coarse = copy.copy(mj_model)
    coarse.vis.quality.shadowsize = min(1024, coarse.vis.quality.shadowsize)
    return coarse


def tile(videos: Sequence[np.ndarray], captions: Sequence[str], *, columns: int) -> np.ndarray:
    """Put videos of one size side by side, each under its caption; one that ends early keeps its last frame."""
    length = max(len(video) for video in videos)
    padded = [video[np.minimum(np.arange(length), len(video) - 1)] for video in videos]
    cells = [_captioned(video, caption) for video, caption in zip(padded, captions, strict=True)]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    rows = [np.concatenate(cells[i : i + columns], axis=2) for i in range(0, len(cells), columns)]
    return np.concatenate(rows, axis=1)


def _captioned(video: np.ndarray, caption: str) -> np.ndarray:
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
