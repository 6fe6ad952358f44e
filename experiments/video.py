"""The video of a report."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from experiments.settings import VideoSettings
from experiments.workspace import Workspace
from mjxgrad.rollouts.render import RenderingUnavailableError, frames, tile, write_video

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
