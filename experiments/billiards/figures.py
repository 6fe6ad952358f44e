"""The pictures of the experiment on billiards."""

from experiments.billiards import hard
from experiments.billiards.measure import IDLE, Outcome
from experiments.settings import VideoSettings
from experiments.theme import MUTED, Drawings, legend_below, looks, subplots
from experiments.video import film
from experiments.workspace import Workspace
from mjxgrad.scene import load_scene
from mjxgrad.tasks import scene_path


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"cost": cost}


def cost(outcome: Outcome):
    """True cost against steps."""
    figure, axes = subplots(1, 1, height=4.4)
    axis = axes[0, 0]
    for run, look in zip(outcome.runs, looks(run.method.label for run in outcome.runs), strict=True):
        style = (0, (4, 2)) if run.touches_at_start else "-"
        axis.plot(run.steps, run.cost, ls=style, ms=4, label=run.method.label, **look)
    for level in (IDLE, hard.optimum()[0]):
        axis.axhline(level, color=MUTED, lw=1.0, ls=(0, (1, 2)), zorder=0)
    axis.set(xlabel="step", ylabel="cost, m²", ylim=(1.3, 2.5))
    legend_below(figure, axis, 3)
    caption = (
        "Cost without noise and with the contact as it is, along each descent. Solid: the balls do not touch at the start; "
        "dashed: they do. Dotted: standing still, and the optimum for hard balls. Descents that coincide cover each other."
    )
    return figure, "Cost against steps", caption


def video(outcome: Outcome, workspace: Workspace) -> tuple[str | None, str]:
    """Draw a stroke that stands still and the best one, and give the file and its caption."""
    mj_model = load_scene(scene_path("billiards")).mj_model
    # Without a GPU fine shadows double the time of a frame, and coarse ones speckle the table.
    mj_model.light_castshadow[:] = False
    apart = [run for run in outcome.runs if not run.touches_at_start] or list(outcome.runs)
    chosen = [max(apart, key=lambda run: run.final_cost), min(apart, key=lambda run: run.final_cost)]
    return film(
        workspace,
        [(mj_model, run.qpos) for run in chosen],
        VideoSettings(speed=0.5, width=400, height=400),
        camera="above",
        caption="The strokes that two descents end with, at 0.5 of real speed; the dark disc is the target.",
        titles=[f"{run.method.label}: {run.final_cost:.3f}" for run in chosen],
        columns=2,
    )
