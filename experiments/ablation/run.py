"""The experiment on leaving out, from settings to report."""

from experiments.ablation.captions import captions
from experiments.ablation.figures import draw
from experiments.ablation.measure import measure
from experiments.ablation.settings import AblationSettings
from experiments.ablation.verdict import findings, tables, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: AblationSettings, workspace: Workspace) -> Report:
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
