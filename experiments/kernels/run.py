"""The experiment on smoothing kernels, from settings to report."""

from experiments.kernels.captions import captions
from experiments.kernels.figures import draw
from experiments.kernels.measure import measure
from experiments.kernels.settings import KernelsSettings
from experiments.kernels.verdict import findings, tables, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: KernelsSettings, workspace: Workspace) -> Report:
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
