"""The experiment on artificial discontinuities, from settings to report."""

from experiments.artificial_discontinuity.captions import captions
from experiments.artificial_discontinuity.figures import draw
from experiments.artificial_discontinuity.measure import measure
from experiments.artificial_discontinuity.settings import ArtificialDiscontinuitySettings
from experiments.artificial_discontinuity.verdict import findings, tables, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: ArtificialDiscontinuitySettings, workspace: Workspace) -> Report:
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
