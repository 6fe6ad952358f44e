"""The experiment on policy gradients, from settings to report."""

from experiments.policy_gradient.captions import captions
from experiments.policy_gradient.figures import draw
from experiments.policy_gradient.measure import measure
from experiments.policy_gradient.settings import PolicyGradientSettings
from experiments.policy_gradient.verdict import findings, tables, verdict
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: PolicyGradientSettings, workspace: Workspace) -> Report:
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
