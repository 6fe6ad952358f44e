"""The experiment on the thrown cube, from settings to report."""

from experiments.cube_toss.figures import captions, draw
from experiments.cube_toss.measure import measure
from experiments.cube_toss.settings import CubeTossSettings
from experiments.cube_toss.verdict import findings, table, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: CubeTossSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.

    Raises:
        ExperimentError: if a time step does not divide the throw, or the reference fails.
    """
    outcome = measure(settings, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
    )
