"""What was planned, as the scene moves under it."""

import copy

import mujoco
import numpy as np

from experiments.planning.outcome import Outcome
from experiments.workspace import Workspace
from mjxgrad.render import RenderingUnavailableError, frames, write_video
from mjxgrad.tasks.planar_pusher import planar_pusher


def video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw the best plan, with the goal as a shade.

    Args:
        outcome: with the plan.
        workspace: for the folder and the clock.

    Returns:
        The file in the output folder, and its caption; without OpenGL None and the reason; None and nothing if no video
        was asked for.
    """
    wanted = outcome.settings.video
    if wanted is None:
        return None, ""
    mj_model = copy.copy(planar_pusher().system.scene.mj_model)
    target = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, "target")
    x, y, turn = outcome.goal
    mj_model.body_pos[target] = [x, y, mj_model.body_pos[target, 2]]
    mj_model.body_quat[target] = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
    still = np.repeat(outcome.shown[-1:], int(1 / outcome.timestep * wanted.speed), axis=0)
    try:
        with workspace.stage("video", "videos", 1) as advance_to:
            pictures = frames(
                mj_model,
                np.concatenate([outcome.shown, still]),
                timestep=outcome.timestep,
                fps=wanted.fps,
                speed=wanted.speed,
                width=wanted.width,
                height=wanted.height,
                camera="above",
            )
            write_video(workspace.folder / "video.mp4", pictures, fps=wanted.fps)
            advance_to(1)
    except RenderingUnavailableError as error:
        return None, str(error)
    return "video.mp4", f"The plan on the scene itself, at {wanted.speed:g} of real speed; the goal in a light shade."
