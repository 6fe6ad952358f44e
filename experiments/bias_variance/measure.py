"""From a problem to the numbers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, PyTree

import mjxgrad as mg
from experiments.bias_variance.settings import Settings
from experiments.config import ExperimentError
from experiments.motion import own_task
from experiments.theme import power
from experiments.words import percent
from experiments.workspace import Workspace
from mjxgrad.checking.motions import compiler_options
from mjxgrad.checking.sweep import Knob
from mjxgrad.diagnostics import BiasVariance, bias_variance
from mjxgrad.objective import Objective, parameter_noise
from mjxgrad.tasks import WALL_CONTACT, BallWall, ball_wall

# What MuJoCo gives a contact that says nothing: solref 0.02 1 and solimp 0.9 0.95 0.001.
_DEFAULT = (1 / (0.02 * 1.0) ** 2, 1.0, (0.9, 0.95), 0.001)
# A ratio of errors nearer to 1 is a tie: a few hundred samples know their variance no better.
_MARGIN = 1.25
# The landscape is smoothed for the picture where it reaches four standard deviations to both sides.
_REACH = 4.0


@dataclass(frozen=True)
class Outcome:
    """Three estimates by `stiffness` (in 1/s²; ascending, the default last if `is_default`) and `angle` (rad).

    `table` has `first_order`, `zeroth_order`, `alpha_order`, `reference` and `bias` in m²/rad, and the variances of one sample of
    the estimates, each with the ends `_low` and `_high` of its interval; whether first order `is_biased` or `has_wrong_sign`; the
    expected errors within the budget and which is clearly smaller. `landscape` has the cost (m²) without noise over `grid` and
    its mean under noise over `smooth_grid`.
    """

    settings: Settings
    table: xr.Dataset
    landscape: xr.Dataset | None
    task: BallWall | None  # to draw, if it can be drawn

    @property
    def swept(self) -> xr.Dataset:
        """The rows of the sweep, without the default."""
        return self.table.isel(stiffness=~self.table.is_default.values)

    def rows(self) -> list[dict[str, Any]]:
        """One row per stiffness and angle, for metrics.csv."""
        return self.table.to_dataframe().reset_index().to_dict("records")


class Ramp(eqx.Module):
    """A step that rises from −1 to 1 with a given slope about zero, on a parabola: a contact's jump in one line."""

    slope: Float[Array, ""]

    def __call__(self, angle: Float[Array, " 1"]) -> Float[Array, ""]:
        """Give the cost."""
        return jnp.clip(self.slope * angle[0], -1, 1) + angle[0] ** 2


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Estimate at every stiffness and angle; an `ExperimentError` if somewhere hardly any rollout was finite."""
    task, knob_name = None, "slope" if settings.problem == "ramp" else "stiffness"
    if settings.problem == "own":
        stiffness, knob, objective = _own(settings, workspace)
    elif settings.problem == "ramp":
        stiffness, knob, objective = _ramp(settings)
    else:
        task = ball_wall()
        workspace.check(task.scene)
        stiffness, knob, objective = _wall(task, settings)
    with workspace.stage("gradients", f"values of {knob_name}", len(stiffness)) as advance_to:

        def whole() -> mg.diagnostics.BiasVariance:
            found = bias_variance(
                objective,
                jnp.asarray(settings.angles)[:, None],
                jax.random.key(settings.seed),
                softness=knob,
                num_samples=settings.num_samples,
                num_reference=settings.reference_samples,
                confidence=settings.confidence,
                compiler_options=compiler_options() if settings.problem == "own" else None,
                progress=lambda done, total: advance_to(done * len(stiffness) // total),
            )
            if found.share < 1:
                raise KeyboardInterrupt
            return found

        measured = workspace.once("gradients", whole)
    if (bad := ~np.isfinite(np.asarray(measured.bias)).all(axis=(1, 2))).any():
        remedy = "take smaller angles, less noise or a smaller slope"
        if knob_name == "stiffness":
            remedy = "leave it out, or lower it until it is stable at the scene's time step (h²k + 2hb < 4)"
        raise ExperimentError(
            f"{knob_name} {', '.join(map(power, stiffness[bad]))} gives no estimate: too few of its rollouts, or of their "
            f"derivatives, are finite; {remedy}"
        )
    workspace.warnings += [text for told in measured.warnings for text in told]
    table = _table(measured, stiffness, settings)
    for i in np.flatnonzero((table.finite_share < 1).any("angle")):
        lost = 1 - float(table.finite_share[i].min())
        workspace.warnings.append(
            f"At {knob_name} {power(stiffness[i])}, {percent(lost)} of the rollouts at one place were not finite and left out, "
            "so its means are over the others."
        )
    return Outcome(settings, table, measured.landscape and _landscape(measured, settings.stddev), task)


def wall_contact(
    task: BallWall, stiffness: Float[np.ndarray, " rows"], damping_ratio: float, *, with_default: bool
) -> mg.Softness:
    """Give the wall each stiffness with its own impedance, and MuJoCo's default contact as one more row."""
    pair = [pair.names for pair in task.scene.pairs].index(WALL_CONTACT[0])
    *impedance, width = task.scene.mj_model.pair_solimp[task.scene.pairs[pair].explicit][:3]
    # MuJoCo reads an impedance of 0 as its smallest, and the scene would warn of it.
    impedance = np.clip(impedance, mujoco.mjMINIMP, mujoco.mjMAXIMP)
    rows = [(value, damping_ratio, impedance, width) for value in stiffness] + [_DEFAULT] * with_default
    stiffness, damping, impedance, width = (np.array(column) for column in zip(*rows, strict=True))
    return mg.Softness(stiffness, damping, impedance, width, pairs=WALL_CONTACT)


# Stiffness by row, what is swept with a leading axis of rows, and from one of these to the cost under noise.
_Problem = tuple[Float[np.ndarray, " rows"], PyTree, Callable[[Any], Objective]]


def _wall(task: BallWall, settings: Settings) -> _Problem:
    knob = wall_contact(
        task, np.sort(settings.stiffness), settings.damping_ratio, with_default=settings.include_default
    )
    return np.asarray(knob.stiffness), knob, lambda softness: task.objective(settings.stddev, softness)


def _own(settings: Settings, workspace: Workspace) -> _Problem:
    task = own_task(settings, seed=settings.seed)
    workspace.check(task.scene)
    if not task.scene.pairs:
        raise ExperimentError(f"no two geoms of {settings.scene} can touch, so there is no stiffness to sweep")
    knob = Knob(task, settings.stddev, settings.seed)
    stiffness = np.array([*sorted(settings.stiffness), *[knob.own] * settings.include_default])
    return stiffness, mg.Softness(stiffness=stiffness), knob


def _ramp(settings: Settings) -> _Problem:
    slopes = np.sort(np.asarray(settings.stiffness))
    knob = jnp.asarray(slopes, jax.dtypes.canonicalize_dtype(float))
    return slopes, knob, lambda slope: parameter_noise(Ramp(slope), settings.stddev, dim=1)


# What the library's table calls by another name.
_NAMES = {
    "truth": "reference",
    "first_bias": "bias",
    "first_is_biased": "is_biased",
    "zeroth_is_biased": "zeroth_is_off",
    "first_variance": "first_order_variance",
    "zeroth_variance": "zeroth_order_variance",
}


def _table(measured: BiasVariance, stiffness: Float[np.ndarray, " rows"], settings: Settings) -> xr.Dataset:
    table, cell = xr.Dataset(coords={"stiffness": stiffness, "angle": list(settings.angles)}), ("stiffness", "angle")
    has_default = settings.problem != "ramp" and settings.include_default
    table["is_default"] = "stiffness", np.arange(len(stiffness)) >= len(stiffness) - has_default
    for name, values in measured.table().items():
        theirs = next((one for one in _NAMES if name.startswith(one)), "")
        table[_NAMES.get(theirs, "") + name.removeprefix(theirs)] = cell, values
    for name, own in {"first_order": "first", "zeroth_order": "zeroth", "alpha_order": "alpha_order"}.items():
        if getattr(measured, own) is None:  # α-order of too few samples
            continue
        mean, (low, high) = getattr(measured, own).value, measured.interval(own)
        for end, values in (("", mean), ("_low", low), ("_high", high)):
            table[name + end] = cell, np.asarray(values)[..., 0]
    # Both means are surely not zero and point in opposite directions.
    table["has_wrong_sign"] = ((table.first_order_low > 0) & (table.reference_high < 0)) | (
        (table.first_order_high < 0) & (table.reference_low > 0)
    )
    # Root of bias² + variance / rollouts.
    budget = settings.rollouts_per_gradient
    bias = table.bias.where(table.is_biased, 0.0)
    table["first_order_error"] = np.hypot(bias, np.sqrt(table.first_order_variance / budget))
    table["zeroth_order_error"] = np.sqrt(table.zeroth_order_variance / budget)
    table["first_wins"] = _MARGIN * table.first_order_error < table.zeroth_order_error
    table["zeroth_wins"] = _MARGIN * table.zeroth_order_error < table.first_order_error
    return table


def _landscape(measured: BiasVariance, stddev: float) -> xr.Dataset:
    """Average the landscape under the noise's density, which costs no further rollouts."""
    assert measured.landscape is not None
    points, costs = np.asarray(measured.landscape.points)[0], np.asarray(measured.landscape.costs)
    grid = np.linspace(points[0] + _REACH * stddev, points[-1] - _REACH * stddev, 300)
    weights = np.exp(-0.5 * ((points[:, None] - grid) / stddev) ** 2)
    smoothed = costs @ (weights / weights.sum(axis=0))
    return xr.Dataset(
        {"cost": (("stiffness", "grid"), costs), "smoothed": (("stiffness", "smooth_grid"), smoothed)},
        coords={"grid": points, "smooth_grid": grid},
    )
