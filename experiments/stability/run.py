"""The experiment on stability, from settings to report."""

from experiments.report import Report
from experiments.stability.captions import captions
from experiments.stability.figures import draw
from experiments.stability.measure import measure
from experiments.stability.settings import StabilitySettings
from experiments.stability.verdict import findings, tables, verdict
from experiments.workspace import Workspace


def run(settings: StabilitySettings, workspace: Workspace) -> Report:
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
        tables=tables(outcome),
        metrics=outcome.rows(),
    )
