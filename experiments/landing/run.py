"""The experiment on impacts, from settings to report."""

from experiments.landing.captions import captions
from experiments.landing.figures import draw
from experiments.landing.measure import measure
from experiments.landing.settings import LandingSettings
from experiments.landing.verdict import findings, table, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: LandingSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.

    Raises:
        ExperimentError: if the readings do not fall on time steps.
    """
    outcome = measure(settings, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
    )
