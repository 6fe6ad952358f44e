"""Bounces: the derivative by each way against slope and closed form, over contact parameters and time steps."""

import functools
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Int
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from pydantic import Field, model_validator

from experiments.motion import ARMS, CONTINUOUS, DISCRETE, SLOPE, at_time_step, motion
from experiments.problems.textbook import bounce_scene
from experiments.report import Table
from experiments.settings import Positive, RunSettings, SettingsTable
from experiments.theme import FIRST, MUTED, ONSET, REFERENCE, ZEROTH, Drawings, legend_below, plain, subplots
from experiments.words import joined, percent
from experiments.workspace import Workspace
from mjxgrad.contact.bounce import Bounce, integrated_restitution
from mjxgrad.diagnostics import SlopeComparison, compare_to_slope, phases
from mjxgrad.scene import Scene

Share = Annotated[float, Field(ge=0, lt=1)]


class ImpedanceSettings(SettingsTable):
    """The first three numbers of `solimp`."""

    first: Share
    """At the surface."""
    last: Annotated[float, Field(gt=0, lt=1)]
    """At depth `width`."""
    width: Positive = 0.001
    """Over which it rises, in m."""

    @property
    def numbers(self) -> tuple[float, float, float]:
        return self.first, self.last, self.width

    @property
    def label(self) -> str:
        if self.first == self.last:
            return f"{self.first:g} throughout"
        return f"{self.first:g} to {self.last:g} in {1e3 * self.width:g} mm"


class Settings(RunSettings):
    """Derivatives of a bounce over contact parameters and time steps, with the closed form."""

    damping_ratios: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=8)]
    """Second number of `solref`."""
    time_constants: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=8)]
    """First number of `solref`, in s."""
    impedances: Annotated[tuple[ImpedanceSettings, ...], Field(min_length=1, max_length=8)]
    """Of `solimp`."""
    timesteps: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=10)]
    """In s, increasing."""
    num_phases: Annotated[int, Field(ge=32)] = 64
    """Start heights over which the slope and the means are taken."""
    heights: tuple[Positive, Positive] = (0.01, 0.05)
    """Between which the ball starts, in m above the floor."""
    duration: Positive = 0.2
    """After which its height is read, in s; it flies at 1 m/s."""

    @model_validator(mode="after")
    def _check(self) -> "Settings":
        if list(self.timesteps) != sorted(set(self.timesteps)):
            raise ValueError(f"timesteps must increase, got {list(self.timesteps)}")
        if not self.heights[0] < self.heights[1]:
            raise ValueError(f"heights must be two numbers, the smaller one first, got {list(self.heights)}")
        if self.heights[1] >= self.duration:
            raise ValueError("duration must be longer than heights[1] / (1 m/s), when the last ball lands")
        return self


SPEED = 1.0  # of the ball towards the floor, in m/s
TOLERANCE = 0.05  # error that a derivative may have, as a share of the larger of the slope and the discrete gradient's own error
CONTACT = ("damping_ratio", "time_constant", "impedance")
_DIMS = ("timestep", *CONTACT)
_NUMBERS = ("first", "last", "width")


@dataclass(frozen=True)
class Outcome:
    """All that was measured, on the grid of `timestep` and of the contacts `damping_ratio`, `time_constant`, `impedance`.

    By `arm`: `mean`, `spread` and `error` of its derivative over the phases, the `slope` of its own height with its
    `slope_error`, and whether it `holds` or `fails`: is within the tolerance, or beyond it by more than two standard errors.
    Besides: `truth`, the derivative of the continuous motion, less the restitution; its `closed_form` where there is one;
    `steps_in_contact`; whether the step `is_stable`, and whether derivatives can be `judged`; `wide`, the mean of differences
    as long as the ball flies in one step, with `wide_spread`.
    """

    settings: Settings
    grid: xr.Dataset

    def rows(self) -> list[dict[str, Any]]:
        """Give one row per arm, contact and time step, for metrics.csv."""
        return self.grid.to_dataframe().reset_index().to_dict("records")


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Compare derivatives with the slope for every contact and time step."""
    cells = list(itertools.product(settings.damping_ratios, settings.time_constants, settings.impedances))
    shape = (len(settings.damping_ratios), len(settings.time_constants), len(settings.impedances))
    scene, starts = bounce_scene(), jnp.asarray(phases(settings.heights, settings.num_phases))
    contacts = (
        jnp.array([(constant, ratio) for ratio, constant, _ in cells]),
        jnp.array([(*impedance.numbers, 0.5, 2.0) for *_, impedance in cells]),
    )
    sampled = []
    with workspace.stage("rollouts", "time steps", len(settings.timesteps)) as advance_to:
        for h in settings.timesteps:
            at_step = functools.partial(_sampled, scene, contacts, starts, settings.duration, h)
            sampled.append(workspace.once(f"{h}", at_step))
            advance_to(len(sampled))
    *columns, wide = (np.stack(each, axis=1).reshape(len(starts), -1, *shape) for each in zip(*sampled, strict=True))
    heights, derivatives = columns[::2], columns[1::2]
    found = [compare_to_slope(starts, y, [dy], (arm,)) for arm, y, dy in zip(ARMS, heights, derivatives, strict=True)]
    # The means of differences need the weights of the derivatives' to be compared with them.
    differences = compare_to_slope(starts, heights[list(ARMS).index(DISCRETE)], [wide], ("wide",))
    with workspace.stage("quadrature", "steps", 1):
        truths = np.array([_truth(*cell) for cell in cells]).reshape(*shape, 3)
    return Outcome(settings, grid_of(settings, found, differences, truths))


def _sampled(
    scene: Scene, contacts: tuple[Array, Array], starts: Array, duration: float, timestep: float
) -> list[Array]:
    """Give heights and derivatives by every arm at one time step, and differences over the way of one step."""
    time, width = (jnp.asarray(timestep), jnp.int32(round(duration / timestep))), SPEED * timestep
    pairs = [_sample(scene, contacts, starts, *time, arm) for arm in ARMS]
    ends = [_sample(scene, contacts, starts + side * width / 2, *time, DISCRETE)[0] for side in (1, -1)]
    return [*itertools.chain(*pairs), (ends[0] - ends[1]) / width]


def grid_of(
    settings: Settings, found: list[SlopeComparison], differences: SlopeComparison, truths: np.ndarray
) -> xr.Dataset:
    """Put together what was found of each arm, what differences give, and truth, closed form and duration of each contact."""

    def by_arm(values: Iterable[np.ndarray]) -> tuple[tuple[str, ...], np.ndarray]:
        return ("arm", *_DIMS), np.stack([value.reshape(found[0].slope.shape) for value in values])

    coords = {"arm": list(ARMS), "impedance": [one.label for one in settings.impedances]}
    for name in ("timestep", "damping_ratio", "time_constant"):
        coords[name] = list(getattr(settings, f"{name}s"))
    numbers = {
        f"impedance_{name}": ("impedance", [getattr(one, name) for one in settings.impedances]) for name in _NUMBERS
    }
    names = ("mean", "spread", "slope", "slope_error")
    grid = xr.Dataset({name: by_arm(getattr(one, name) for one in found) for name in names}, coords | numbers).assign(
        error=by_arm(one.relative_error for one in found),
        wide=(_DIMS, differences.mean[0]),
        wide_spread=(_DIMS, differences.spread[0]),
        truth=(CONTACT, truths[..., 0]),
        closed_form=(CONTACT, truths[..., 1]),
    )
    ratio = grid.damping_ratio
    # The step can follow the contact if h / t_c < 2 ζ (√(1 + ζ²) − ζ).
    grid["is_stable"] = grid.timestep < 2 * ratio * (np.sqrt(1 + ratio**2) - ratio) * grid.time_constant
    grid["steps_in_contact"] = xr.DataArray(truths[..., 2], dims=CONTACT) / grid.timestep
    grid["judged"] = (grid.slope_error <= TOLERANCE * abs(grid.slope)).all("arm") & grid.is_stable
    grid = grid.assign(
        holds=by_arm(one.is_close(TOLERANCE) for one in found), fails=by_arm(one.is_off(TOLERANCE) for one in found)
    )
    return grid.assign(holds=grid.holds & grid.judged, fails=grid.fails & grid.judged)


def _truth(ratio: float, constant: float, impedance: ImpedanceSettings) -> tuple[float, float, float]:
    """Give the derivative by quadrature and in closed form (NaN where the impedance varies), and the contact's duration (s)."""
    restitution, duration = integrated_restitution(constant, ratio, impedance.numbers, SPEED)
    closed = -float(Bounce(constant, ratio, SPEED).restitution) if impedance.first == impedance.last else np.nan
    return -restitution, closed, duration


def _height(qpos: Float[Array, " 1"], qvel: Float[Array, " 1"]) -> Float[Array, ""]:
    return qpos[0]


@eqx.filter_jit
def _sample(
    scene: Scene, contacts: tuple[Array, Array], starts: Array, timestep: Array, num_steps: Array, arm: str
) -> tuple[Float[Array, "phases contacts"], Float[Array, "phases contacts"]]:
    """Give heights and derivatives from every start on every contact, as a single batch.

    Time steps differ in arrays alone, so one compilation serves them all.
    """
    (solref, solimp), count = contacts, len(contacts[0])

    def height(start: Float[Array, ""], contact: Int[Array, ""]) -> Float[Array, ""]:
        model = at_time_step(scene.model, timestep)
        model = model.replace(
            geom_solref=jnp.broadcast_to(solref[contact], model.geom_solref.shape),
            geom_solimp=jnp.broadcast_to(solimp[contact], model.geom_solimp.shape),
        )
        data = scene.data.replace(qpos=start[None], qvel=jnp.array([-SPEED]))
        return motion(model, data, _height, num_times=1, steps_between=num_steps, contact=ARMS[arm])[0]

    def one(start: Float[Array, ""], contact: Int[Array, ""]) -> tuple[Array, Array]:
        return jax.jvp(lambda x: height(x, contact), (start,), (jnp.ones_like(start),))

    values = jax.vmap(one)(jnp.repeat(starts, count), jnp.tile(jnp.arange(count), len(starts)))
    return jax.tree.map(lambda x: x.reshape(len(starts), count), values)


# Steps in contact by which the outcome is told apart.
_STEPS = (0, 3, 6, 10, 20, np.inf)
# Largest time step at which the tolerance is asked for, and one at which this one is enough (s).
_FINE, _COARSE, _COARSE_TOLERANCE = 5e-4, 2e-3, 0.3
_ORDER = (CONTINUOUS, SLOPE, DISCRETE)


def answer(outcome: Outcome) -> str:
    """Say how often the derivative is the slope, by both derivatives."""
    fine = outcome.grid.isel(timestep=outcome.grid.timestep.values <= _FINE)
    judged = int(fine.judged.sum())
    if not judged:
        return "At no contact is the slope known well enough: take more phases."
    shares = [f"{int(fine.holds.sel(arm=arm).sum())} ({arm})" for arm in _ORDER]
    return f"Right at {joined(shares)} of {judged} settings."


def verdict(outcome: Outcome) -> str:
    """Say how often each derivative is the slope."""
    grid = outcome.grid
    fine = grid.isel(timestep=grid.timestep.values <= _FINE)
    coarse = grid.isel(timestep=np.isclose(grid.timestep.values, _COARSE))
    judged = int(fine.judged.sum())
    if not judged:
        return "At no contact is the slope known well enough: take more phases."
    within = [f"{int(fine.holds.sel(arm=arm).sum())} ({arm})" for arm in _ORDER]
    sentence = (
        f"Up to {1e3 * _FINE:g} ms the mean derivative is within {TOLERANCE:.0%} of the slope at {joined(within)} of {judged} "
        "contacts and time steps."
    )
    if not coarse.timestep.size:
        return sentence
    close = [int(((coarse.error <= _COARSE_TOLERANCE) & coarse.judged).sel(arm=arm).sum()) for arm in _ORDER]
    return (
        f"{sentence} At {1e3 * _COARSE:g} ms it is within {_COARSE_TOLERANCE:.0%} at {close[0]} and {close[1]} (slope) of "
        f"{int(coarse.judged.sum())}."
    )


def findings(outcome: Outcome) -> list[str]:
    """Say what no table shows: the discrete gradient by how contact sets in, differences, and how well the truth is known."""
    grid, sentences = outcome.grid, []
    if not grid.judged.any():
        return []
    slope, discrete = abs(grid.slope.sel(arm=DISCRETE)), grid["mean"].sel(arm=DISCRETE)
    jumps = (abs(discrete) / slope).where(grid.judged & (grid.impedance_first > 0))
    if jumps.notnull().any():
        sentences.append(
            f"Where contact sets in with a jump of force the discrete gradient is {float(jumps.median()):.3g} times the slope "
            f"in the median and up to {float(jumps.max()):.3g} times."
        )
    gentle = (abs(grid["mean"].sel(arm=SLOPE) - discrete) / slope).where(grid.judged & (grid.impedance_first == 0))
    if gentle.notnull().any():
        sentences.append(
            "Where contact sets in gently there is nothing to correct, and both gradients differ by "
            f"{percent(float(gentle.median()))} of the slope in the median and {percent(float(gentle.max()))} at most."
        )
    wide = (abs(grid.wide - grid.slope.sel(arm=DISCRETE)) / slope).where(grid.judged)
    sentences.append(
        f"Finite differences over one step's flight, two rollouts per parameter, are off by {percent(float(wide.median()))} "
        f"of the slope in the median and {percent(float(wide.max()))} at most."
    )
    if grid.closed_form.notnull().any():
        finest = grid.isel(timestep=0)
        off = (abs(finest.slope - grid.truth) / abs(grid.truth)).where(finest.judged).max(CONTACT)
        sentences.append(
            f"Quadrature and closed form agree to {float(abs(grid.truth - grid.closed_form).max()):.0e} where there is one. At "
            f"{1e3 * float(finest.timestep):g} ms the slope of the simulated height is within "
            f"{percent(float(off.sel(arm=DISCRETE)))} of the truth, with an onset within "
            f"{percent(float(off.sel(arm=CONTINUOUS)))}."
        )
    return sentences


def tables(outcome: Outcome) -> list[Table]:
    """Tabulate where the derivatives hold by how many steps the contact lasts."""
    grid, rows = outcome.grid, []
    spread = grid.spread / abs(grid.slope)
    for low, high in itertools.pairwise(_STEPS):
        inside = grid.judged & (grid.steps_in_contact >= low) & (grid.steps_in_contact < high)
        if not inside.any():
            continue
        row = [f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} and more", str(int(inside.sum()))]
        for arm in _ORDER:
            error, width = (float(one.sel(arm=arm).where(inside).median()) for one in (grid.error, spread))
            row += [str(int(grid.holds.sel(arm=arm).where(inside, False).sum())), f"{error:.1%}", f"{width:.2g}"]
        rows.append(row)
    heads = [f"{what}, {arm}" for arm in _ORDER for what in (f"within {TOLERANCE:.0%}", "error", "spread")]
    caption = (
        "Contacts and time steps by how long the contact lasts. Error of the mean derivative as a share of the slope of its own "
        "height, at most 100%, and standard deviation of single derivatives over the slope: medians."
    )
    return [Table(("steps in contact", "judged", *heads), rows, caption)]


_LOOKS = {DISCRETE: (FIRST, "o"), SLOPE: (ZEROTH, "s"), CONTINUOUS: (ONSET, "D")}


def drawings(outcome: Outcome) -> Drawings:
    """Name the figures in order of reading."""
    return {"derivative": derivative, "error": error}


def derivative(outcome: Outcome):
    """Means and spreads of all derivatives against the time step, for each damping ratio at one contact."""
    settings, grid = outcome.settings, outcome.grid
    # MuJoCo's own time constant and impedance, or what comes nearest.
    at = {
        "time_constant": int(np.argmin(abs(grid.time_constant.values - 0.02))),
        "impedance": int(np.argmin((abs(grid.impedance_first - 0.9) + abs(grid.impedance_last - 0.95)).values)),
    }
    shown = grid.isel(at).isel(damping_ratio=slice(None, None, -(-len(settings.damping_ratios) // 5)))
    figure, axes = subplots(1, shown.damping_ratio.size, height=3.6, sharey=True)
    h = 1e3 * shown.timestep.values
    for axis, ratio in zip(axes[0], shown.damping_ratio.values, strict=True):
        one = shown.sel(damping_ratio=ratio)
        axis.axhline(one.truth, color=REFERENCE, lw=1, ls=(0, (2, 2)), label="truth")
        axis.plot(h, one.slope.sel(arm=DISCRETE), color=REFERENCE, lw=2.6, label="slope of the simulated height")
        means = {arm: (one["mean"].sel(arm=arm), one.spread.sel(arm=arm), *look) for arm, look in _LOOKS.items()}
        means["difference over one step's flight"] = one.wide, one.wide_spread, MUTED, "^"
        for shift, (label, (mean, spread, colour, marker)) in zip((0.94, 0.98, 1.02, 1.06), means.items(), strict=True):
            axis.errorbar(
                h * shift, mean, spread, color=colour, marker=marker, ms=4, lw=1, elinewidth=1, capsize=2, label=label
            )
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=0.1)
        axis.set(title=f"damping ratio {ratio:g}", xlabel="time step, ms")
        plain(axis.xaxis)
        plain(axis.yaxis)
    axes[0, 0].set_ylabel("derivative")
    name = f"Time constant {1e3 * float(shown.time_constant):g} ms, impedance {shown.impedance.values}"
    figure.suptitle(name, fontsize=10)
    legend_below(figure, axes[0, 0], 3)
    caption = (
        f"Derivative of the height after {settings.duration:g} s with respect to the start height, mean over "
        f"{settings.num_phases} start heights; bars are the standard deviation over them, the phases of the time step. The "
        "truth is less the restitution, by quadrature of the contact's own equation. Finite differences span what the ball "
        "flies in one step. The axis is linear between −0.1 and 0.1."
    )
    return figure, "Derivative against time step", caption


def error(outcome: Outcome):
    """A map per impedance and time step: damping ratio across, time constant up."""
    settings, grid = outcome.settings, outcome.grid.sel(arm=CONTINUOUS)
    rows, columns = grid.impedance.size, grid.timestep.size
    figure, axes = subplots(rows, columns, height=0.9 + 1.35 * rows, sharex=True, sharey=True)
    look = ScalarMappable(LogNorm(1e-3, 1), "RdYlBu_r")
    for i, j in np.ndindex(rows, columns):
        axis, one = axes[i, j], grid.isel(impedance=i, timestep=j).transpose("time_constant", "damping_ratio")
        axis.imshow(one.error.clip(1e-3, 1), norm=look.norm, cmap=look.cmap, origin="lower", aspect="auto")
        for where, marker, size in ((~one.judged, "x", 6), (one.judged & ~one.holds & ~one.fails, ".", 4)):
            up, across = np.nonzero(where.values)
            axis.plot(across, up, marker, color=REFERENCE, ms=size)
        axis.grid(visible=False)
        axis.set_xticks(range(grid.damping_ratio.size), [f"{value:g}" for value in settings.damping_ratios])
        axis.set_yticks(range(grid.time_constant.size), [f"{1e3 * value:g}" for value in settings.time_constants])
        if i == 0:
            axis.set_title(f"{1e3 * settings.timesteps[j]:g} ms")
        if i == rows - 1:
            axis.set_xlabel("damping ratio")
        if j == 0:
            axis.set_ylabel(f"{settings.impedances[i].label}\ntime constant, ms", fontsize=8)
    bar = figure.colorbar(look, ax=axes, shrink=0.8, pad=0.01)
    names = {1e-3: "≤ 0.1%", 1e-2: "1%", TOLERANCE: f"{TOLERANCE:.0%}", 0.3: "30%", 1: "≥ 100%"}
    bar.set_ticks(list(names), labels=list(names.values()))
    bar.ax.minorticks_off()
    caption = (
        "Error of the derivative with contact that begins within the step, as a share of the slope, one square per contact. A "
        "dot: beyond the tolerance, but not beyond two standard errors of the means. Crossed squares are not judged: the step "
        "is unstable there, or the slope is not known well enough."
    )
    return figure, "Error over all contacts", caption
