"""The optimisation experiment, from settings to report."""

import json

from experiments.optimisation.captions import captions
from experiments.optimisation.figures import draw
from experiments.optimisation.measure import measure
from experiments.optimisation.settings import OptimisationSettings
from experiments.optimisation.verdict import findings, headline, table, verdict, warnings
from experiments.overview import HEADLINE
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: OptimisationSettings, workspace: Workspace) -> Report:
    """Optimise, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures go.

    Returns:
        The report.
    """
    outcome = measure(settings, workspace)
    (workspace.folder / HEADLINE).write_text(json.dumps(headline(outcome), indent=2) + "\n", encoding="utf-8")
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=draw(outcome, workspace.folder, captions(outcome)),
        tables=[table(outcome)],
        metrics=outcome.rows(),
        warnings=warnings(outcome),
    )
