"""Throws side by side."""

import copy

import jax
import jax.numpy as jnp
import numpy as np

from experiments.bias_variance.problems import Problem, wall_contact
from experiments.bias_variance.settings import BiasVarianceSettings
from experiments.theme import power
from experiments.workspace import Workspace
from mjxgrad.render import RenderingUnavailableError, frames, tile, write_video


def video(problem: Problem, settings: BiasVarianceSettings, workspace: Workspace) -> tuple[str | None, str]:
    """Draw the rollouts that the settings ask for.

    Args:
        problem: with a task, if it can be drawn.
        settings: of the run.
        workspace: for the folder and the clock.

    Returns:
        The file in the output folder, and its caption; without OpenGL None and the reason; None and nothing if no video
        was asked for.
    """
    wanted, task = settings.video, problem.task
    if wanted is None or task is None:
        return None, ""
    only_swept = settings.model_copy(update={"include_default": False})
    knob = wall_contact(task, np.asarray(wanted.stiffness), only_swept)

    @jax.jit
    def throw(softness, angles):
        thrown = task.with_softness(softness)
        return jax.vmap(lambda angle: thrown.trajectory(angle[None]).qpos)(angles)

    clips, captions = [], []

    mj_model = copy.copy(task.scene.mj_model)
    # Without a GPU the scene's fine shadows double the time of a frame, and in a small picture nobody sees them.
    mj_model.vis.quality.shadowsize = min(1024, mj_model.vis.quality.shadowsize)

    def draw(qpos):
        return frames(
            mj_model,
            np.asarray(qpos),
            timestep=mj_model.opt.timestep,
            fps=wanted.fps,
            speed=wanted.speed,
            width=wanted.width,
            height=wanted.height,
            camera="side",
        )

    try:
        with workspace.stage("video", "throws", len(wanted.stiffness) * len(wanted.angles)) as advance_to:
            for i, stiffness in enumerate(wanted.stiffness):
                softness = jax.tree.map(lambda leaf, i=i: leaf[i], knob)
                for angle, qpos in zip(wanted.angles, throw(softness, jnp.asarray(wanted.angles)), strict=True):
                    clips.append(draw(qpos))
                    captions.append(f"{angle:g} rad, stiffness {power(stiffness)} 1/s²")
                    advance_to(len(clips))
            tiled = tile(clips, captions, columns=len(wanted.angles))
            write_video(workspace.folder / "video.mp4", tiled, fps=wanted.fps)
    except RenderingUnavailableError as error:
        return None, str(error)
    caption = "Throws without noise, by angle (columns) and stiffness of the wall (rows)"
    return "video.mp4", f"{caption}, {_speed(wanted.speed)}."


def _speed(speed: float) -> str:
    return "at real speed" if speed == 1 else f"at {speed:g} of real speed"
