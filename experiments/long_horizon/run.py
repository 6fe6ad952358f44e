"""The experiment on long horizons, from settings to report."""

from experiments.long_horizon.captions import captions
from experiments.long_horizon.figures import draw
from experiments.long_horizon.measure import measure
from experiments.long_horizon.settings import LongHorizonSettings
from experiments.long_horizon.verdict import findings, tables, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: LongHorizonSettings, workspace: Workspace) -> Report:
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
