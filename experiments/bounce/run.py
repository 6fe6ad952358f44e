"""The experiment on bounces, from settings to report."""

from experiments.bounce.captions import captions
from experiments.bounce.figures import draw
from experiments.bounce.measure import measure
from experiments.bounce.settings import BounceSettings
from experiments.bounce.verdict import findings, tables, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: BounceSettings, workspace: Workspace) -> Report:
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
