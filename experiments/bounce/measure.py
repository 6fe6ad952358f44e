"""From settings to numbers."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Int

from experiments.bounce.settings import ImpedanceSettings, Settings
from experiments.motion import ARMS, DISCRETE, at_time_step, motion
from experiments.workspace import Workspace
from mjxgrad.contact.bounce import Bounce, integrated_restitution
from mjxgrad.diagnostics import SlopeComparison, compare_to_slope, phases
from mjxgrad.scene import Scene
from mjxgrad.tasks.textbook import bounce_scene

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
            time, width = (jnp.asarray(h), jnp.int32(round(settings.duration / h))), SPEED * h
            pairs = [_sample(scene, contacts, starts, *time, arm) for arm in ARMS]
            ends = [_sample(scene, contacts, starts + side * width / 2, *time, DISCRETE)[0] for side in (1, -1)]
            sampled.append([*itertools.chain(*pairs), (ends[0] - ends[1]) / width])
            advance_to(len(sampled))
    *columns, wide = (np.stack(each, axis=1).reshape(len(starts), -1, *shape) for each in zip(*sampled, strict=True))
    heights, derivatives = columns[::2], columns[1::2]
    found = [compare_to_slope(starts, y, [dy], (arm,)) for arm, y, dy in zip(ARMS, heights, derivatives, strict=True)]
    # The means of differences need the weights of the derivatives' to be compared with them.
    differences = compare_to_slope(starts, heights[list(ARMS).index(DISCRETE)], [wide], ("wide",))
    with workspace.stage("quadrature", "steps", 1):
        truths = np.array([_truth(*cell) for cell in cells]).reshape(*shape, 3)
    return Outcome(settings, grid_of(settings, found, differences, truths))


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
    (gradient, onset), (solref, solimp), count = ARMS[arm], contacts, len(contacts[0])

    def height(start: Float[Array, ""], contact: Int[Array, ""]) -> Float[Array, ""]:
        model = at_time_step(scene.model, timestep)
        model = model.replace(
            geom_solref=jnp.broadcast_to(solref[contact], model.geom_solref.shape),
            geom_solimp=jnp.broadcast_to(solimp[contact], model.geom_solimp.shape),
        )
        data = scene.data.replace(qpos=start[None], qvel=jnp.array([-SPEED]))
        return motion(model, data, _height, num_times=1, steps_between=num_steps, gradient=gradient, onset=onset)[0]

    def one(start: Float[Array, ""], contact: Int[Array, ""]) -> tuple[Array, Array]:
        return jax.jvp(lambda x: height(x, contact), (start,), (jnp.ones_like(start),))

    values = jax.vmap(one)(jnp.repeat(starts, count), jnp.tile(jnp.arange(count), len(starts)))
    return jax.tree.map(lambda x: x.reshape(len(starts), count), values)
