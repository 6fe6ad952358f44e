"""The experiment on billiards, from settings to report."""

from experiments.billiards.figures import captions, draw
from experiments.billiards.measure import measure
from experiments.billiards.settings import BilliardsSettings
from experiments.billiards.verdict import findings, table, verdict
from experiments.billiards.video import video
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: BilliardsSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.
    """
    outcome = measure(settings, workspace)
    file, caption = video(outcome, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
        video=file,
        video_caption=caption,
    )
