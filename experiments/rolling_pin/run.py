"""The rolling pin's experiment, from settings to report."""

import copy

from experiments.report import Report
from experiments.rolling_pin.captions import captions
from experiments.rolling_pin.figures import draw
from experiments.rolling_pin.measure import measure
from experiments.rolling_pin.outcome import Outcome
from experiments.rolling_pin.settings import RollingPinSettings
from experiments.rolling_pin.verdict import findings, table, verdict
from experiments.workspace import Workspace
from mjxgrad.render import RenderingUnavailableError, frames, write_video


def run(settings: RollingPinSettings, workspace: Workspace) -> Report:
    """Descend, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.
    """
    outcome = measure(settings, workspace)
    video, caption = _video(outcome, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
        video=video,
        video_caption=caption,
    )


def _video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw the motion of the best controls; without OpenGL give the reason instead of a file."""
    wanted = outcome.settings.video
    if wanted is None:
        return None, ""
    mj_model = copy.copy(outcome.task.scene.mj_model)
    # Without a GPU fine shadows double the time of a frame, and in a small picture nobody sees them.
    mj_model.vis.quality.shadowsize = min(1024, mj_model.vis.quality.shadowsize)
    try:
        with workspace.stage("video", "motions", 1) as advance_to:
            drawn = frames(
                mj_model,
                outcome.motion,
                timestep=mj_model.opt.timestep,
                fps=wanted.fps,
                speed=wanted.speed,
                width=wanted.width,
                height=wanted.height,
                camera="side",
            )
            write_video(workspace.folder / "video.mp4", drawn, fps=wanted.fps)
            advance_to(1)
    except RenderingUnavailableError as error:
        return None, str(error)
    return "video.mp4", (
        f"The motion that {outcome.best.label} ends with, at {wanted.speed:g} of real speed; the green line is the depth "
        "that was asked for."
    )
