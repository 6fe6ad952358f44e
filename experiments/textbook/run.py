"""The experiment on a textbook problem, from settings to report."""

from experiments.report import Report
from experiments.textbook.captions import captions
from experiments.textbook.figures import draw
from experiments.textbook.measure import measure
from experiments.textbook.settings import TextbookSettings
from experiments.textbook.verdict import findings, table, verdict
from experiments.workspace import Workspace


def run(settings: TextbookSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.

    Raises:
        ExperimentError: if there is no estimator of some name.
    """
    outcome = measure(settings, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
    )
