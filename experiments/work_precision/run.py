"""The experiment on error against run time, from settings to report."""

from experiments.report import Report
from experiments.work_precision.captions import captions
from experiments.work_precision.figures import draw
from experiments.work_precision.measure import measure
from experiments.work_precision.settings import WorkPrecisionSettings
from experiments.work_precision.verdict import batches, findings, summary, verdict
from experiments.workspace import Workspace


def run(settings: WorkPrecisionSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.
    """
    outcome = measure(settings, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        summary=summary(outcome),
        tables=[batches(outcome)],
        metrics=outcome.rows(),
    )
