"""The strokes side by side."""

from experiments.billiards.outcome import Outcome
from experiments.workspace import Workspace
from mjxgrad.render import RenderingUnavailableError, frames, tile, write_video
from mjxgrad.scene import load_scene
from mjxgrad.tasks.files import scene_path

_FPS, _SPEED = 30.0, 0.5


def video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw a stroke that stands still and the best one.

    Args:
        outcome: the numbers.
        workspace: for the folder and the clock.

    Returns:
        The file in the output folder and its caption; without OpenGL None and the reason.
    """
    mj_model = load_scene(scene_path("billiards")).mj_model
    # Without a GPU fine shadows double the time of a frame, and coarse ones speckle the table.
    mj_model.light_castshadow[:] = False
    apart = [run for run in outcome.runs if not run.has_touched] or list(outcome.runs)
    chosen = [max(apart, key=lambda run: run.final_cost), min(apart, key=lambda run: run.final_cost)]
    clips = []
    try:
        with workspace.stage("video", "strokes", len(chosen)) as advance_to:
            for run in chosen:
                clips.append(
                    frames(
                        mj_model, run.qpos, timestep=outcome.timestep, fps=_FPS, speed=_SPEED,
                        width=400, height=400, camera="above",
                    )
                )  # fmt: skip
                advance_to(len(clips))
            captions = [f"{run.method.label}: {run.final_cost:.3f}" for run in chosen]
            write_video(workspace.folder / "video.mp4", tile(clips, captions, columns=2), fps=_FPS)
    except RenderingUnavailableError as error:
        return None, str(error)
    return (
        "video.mp4",
        f"The strokes that two descents end with, at {_SPEED:g} of real speed; the dark disc is the target.",
    )
