"""The planning experiment, from settings to report."""

from experiments.planning.captions import captions
from experiments.planning.figures import draw
from experiments.planning.measure import measure
from experiments.planning.settings import PlanningSettings
from experiments.planning.verdict import findings, table, verdict
from experiments.planning.video import video
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: PlanningSettings, workspace: Workspace) -> Report:
    """Plan, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures and video go.

    Returns:
        The report.
    """
    outcome = measure(settings, workspace)
    file, video_caption = video(outcome, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
        video=file,
        video_caption=video_caption,
    )
