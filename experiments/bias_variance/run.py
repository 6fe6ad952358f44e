"""The bias and variance experiment, from settings to report."""

from experiments.bias_variance.captions import captions
from experiments.bias_variance.figures import draw
from experiments.bias_variance.measure import measure, scene_warnings
from experiments.bias_variance.problems import problem
from experiments.bias_variance.settings import BiasVarianceSettings
from experiments.bias_variance.verdict import findings, table, verdict
from experiments.bias_variance.video import video
from experiments.report import Report
from experiments.workspace import Workspace


def run(settings: BiasVarianceSettings, workspace: Workspace) -> Report:
    """Measure, draw, and say what follows.

    Args:
        settings: of the run.
        workspace: where figures and video go.

    Returns:
        The report.

    Raises:
        ExperimentError: if some stiffness gives no estimate.
    """
    setup = problem(settings)
    outcome = measure(setup, settings, workspace)
    figures = draw(outcome, workspace.folder, captions(outcome))
    file, video_caption = video(setup, settings, workspace)
    return Report(
        verdict=verdict(outcome),
        details=findings(outcome),
        figures=figures,
        tables=[table(outcome)],
        metrics=outcome.rows(),
        video=file,
        video_caption=video_caption,
        warnings=scene_warnings(setup, outcome.finite),
    )
