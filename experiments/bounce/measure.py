"""From settings to numbers."""

import itertools
from collections.abc import Callable
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
from mjxgrad.diagnostics import SlopeComparison, compare_to_slope, phases
from mjxgrad.scene import Scene
from mjxgrad.tasks.textbook import Bounce, bounce_scene, integrated_restitution

_TINY = 1e-7  # m; the ball flies 500 times as far in the shortest of time steps
CONTACT = ("damping_ratio", "time_constant", "impedance")
_DIMS = ("timestep", *CONTACT)


@dataclass(frozen=True)
class Outcome:
    """All that was measured, on the grid of `timestep` and of the contacts `damping_ratio`, `time_constant`, `impedance`.

    By `arm`: `mean`, `spread` and `error` of its derivative over the phases, the `slope` of its own height with its
    `slope_error`, and whether it `holds` or `fails`: is within the tolerance, or beyond it by more than two standard errors.
    Besides: `truth`, the derivative of the continuous motion, less the restitution; its `closed_form` where there is one;
    `steps_in_contact`; whether the step `is_stable`, and whether derivatives can be `judged`; `tiny` and `wide`, the mean of
    differences far shorter than a time step and as long as the ball flies in one, with `wide_spread`.
    """

    settings: Settings
    grid: xr.Dataset

    def rows(self) -> list[dict[str, Any]]:
        """Give one row per arm, contact and time step, for metrics.csv."""
        return self.grid.to_dataframe().reset_index().to_dict("records")


class _Contacts(eqx.Module):
    """All contacts at one time step; time steps differ in arrays alone, so one compilation serves them all."""

    scene: Scene
    solref: Float[Array, "cells 2"]
    solimp: Float[Array, "cells 5"]
    timestep: Float[Array, ""]
    num_steps: Int[Array, ""]
    speed: Float[Array, ""]

    def height(self, start: Float[Array, ""], cell: Int[Array, ""], arm: str) -> Float[Array, ""]:
        """Bounce once, from a start height to the height at the end."""
        model = at_time_step(self.scene.model, self.timestep)
        model = model.replace(
            geom_solref=jnp.broadcast_to(self.solref[cell], model.geom_solref.shape),
            geom_solimp=jnp.broadcast_to(self.solimp[cell], model.geom_solimp.shape),
        )
        data = self.scene.data.replace(qpos=start[None], qvel=-self.speed[None])
        gradient, onset = ARMS[arm]
        read = motion(model, data, _height, num_times=1, steps_between=self.num_steps, gradient=gradient, onset=onset)
        return read[0]


def measure(settings: Settings, workspace: Workspace) -> Outcome:
    """Compare derivatives with the slope for every contact and time step."""
    cells = list(itertools.product(settings.damping_ratios, settings.time_constants, settings.impedances))
    scene, starts = bounce_scene(), jnp.asarray(phases(settings.heights, settings.num_phases))
    sampled = []
    with workspace.stage("rollouts", "time steps", len(settings.timesteps)) as advance_to:
        for timestep in settings.timesteps:
            contacts = _contacts(scene, cells, settings, timestep)
            pairs = [_values_and_derivatives(contacts, starts, arm) for arm in ARMS]
            widths = (_TINY, settings.speed * timestep)
            quotients = [_differences(contacts, starts, width) for width in widths]
            sampled.append([*itertools.chain(*pairs), *quotients])
            advance_to(len(sampled))
    shape = (len(settings.damping_ratios), len(settings.time_constants), len(settings.impedances))
    columns = [np.stack(each, axis=1) for each in zip(*sampled, strict=True)]
    *columns, tiny, wide = [column.reshape(*column.shape[:2], *shape) for column in columns]
    heights = dict(zip(ARMS, columns[::2], strict=True))
    found = [
        compare_to_slope(starts, heights[arm], [derivative], (arm,))
        for arm, derivative in zip(ARMS, columns[1::2], strict=True)
    ]
    # The means of differences need the weights of the derivatives' to be compared with them.
    differences = compare_to_slope(starts, heights[DISCRETE], [tiny, wide], ("tiny", "wide"))
    with workspace.stage("quadrature", "steps", 1):
        truths = np.array([_truth(settings.speed, *cell) for cell in cells]).reshape(*shape, 3)
    return Outcome(settings, _grid(settings, found, differences, truths))


def _grid(
    settings: Settings, found: list[SlopeComparison], differences: SlopeComparison, truths: np.ndarray
) -> xr.Dataset:
    def by_arm(read: Callable[[SlopeComparison], np.ndarray]) -> tuple[tuple[str, ...], np.ndarray]:
        return ("arm", *_DIMS), np.stack([read(one) for one in found])

    tolerance, timesteps = settings.tolerance, np.array(settings.timesteps)[:, None, None, None]
    ratio, constant = np.array(settings.damping_ratios)[:, None, None], np.array(settings.time_constants)[:, None]
    # The step can follow the contact if h / t_c < 2 ζ (√(1 + ζ²) − ζ).
    is_stable = timesteps < 2 * ratio * (np.sqrt(1 + ratio**2) - ratio) * constant + 0 * truths[..., 0]
    grid = xr.Dataset(
        {
            "mean": by_arm(lambda one: one.mean[0]),
            "spread": by_arm(lambda one: one.spread[0]),
            "slope": by_arm(lambda one: one.slope),
            "slope_error": by_arm(lambda one: one.slope_error),
            "error": by_arm(lambda one: one.relative_error[0]),
            "tiny": (_DIMS, differences.mean[0]),
            "wide": (_DIMS, differences.mean[1]),
            "wide_spread": (_DIMS, differences.spread[1]),
            "truth": (CONTACT, truths[..., 0]),
            "closed_form": (CONTACT, truths[..., 1]),
            "steps_in_contact": (_DIMS, truths[..., 2] / timesteps),
            "is_stable": (_DIMS, is_stable),
        },
        coords={
            "arm": list(ARMS),
            "timestep": list(settings.timesteps),
            "damping_ratio": list(settings.damping_ratios),
            "time_constant": list(settings.time_constants),
            "impedance": [one.label for one in settings.impedances],
            "impedance_first": ("impedance", [one.first for one in settings.impedances]),
            "impedance_last": ("impedance", [one.last for one in settings.impedances]),
            "width": ("impedance", [one.width for one in settings.impedances]),
        },
    )
    judged = (grid.slope_error <= tolerance * abs(grid.slope)).all("arm") & grid.is_stable
    return grid.assign(
        judged=judged,
        holds=judged & by_arm(lambda one: one.is_close(tolerance)[0]),
        fails=judged & by_arm(lambda one: one.is_off(tolerance)[0]),
    )


def _truth(speed: float, ratio: float, constant: float, impedance: ImpedanceSettings) -> tuple[float, float, float]:
    """Give the derivative by quadrature and in closed form (NaN where the impedance varies), and the contact's duration (s)."""
    restitution, duration = integrated_restitution(constant, ratio, impedance.numbers, speed)
    closed = -float(Bounce(constant, ratio, speed).restitution) if impedance.first == impedance.last else np.nan
    return -restitution, closed, duration


def _contacts(scene: Scene, cells: list[tuple], settings: Settings, timestep: float) -> _Contacts:
    return _Contacts(
        scene,
        jnp.array([(constant, ratio) for ratio, constant, _ in cells]),
        jnp.array([(*impedance.numbers, 0.5, 2.0) for *_, impedance in cells]),
        jnp.asarray(timestep),
        jnp.int32(round(settings.duration / timestep)),
        jnp.asarray(settings.speed),
    )


def _height(qpos: Float[Array, " 1"], qvel: Float[Array, " 1"]) -> Float[Array, ""]:
    return qpos[0]


@eqx.filter_jit
def _values_and_derivatives(
    contacts: _Contacts, starts: Float[Array, " phases"], arm: str
) -> tuple[Float[Array, "phases cells"], Float[Array, "phases cells"]]:
    def one(start: Float[Array, ""], cell: Int[Array, ""]) -> tuple[Array, Array]:
        return jax.jvp(lambda x: contacts.height(x, cell, arm), (start,), (jnp.ones_like(start),))

    return _over_grid(one, starts, contacts)


@eqx.filter_jit
def _values(contacts: _Contacts, starts: Float[Array, " phases"]) -> Float[Array, "phases cells"]:
    return _over_grid(lambda start, cell: contacts.height(start, cell, DISCRETE), starts, contacts)


def _over_grid(function: Callable, starts: Float[Array, " phases"], contacts: _Contacts):
    """Evaluate at every start and every contact, as a single batch."""
    count = len(contacts.solref)
    values = jax.vmap(function)(jnp.repeat(starts, count), jnp.tile(jnp.arange(count), len(starts)))
    return jax.tree.map(lambda x: x.reshape(len(starts), count), values)


def _differences(contacts: _Contacts, starts: Float[Array, " phases"], width: float) -> Float[Array, "phases cells"]:
    """Give central differences of a width at each start."""
    ahead, behind = (_values(contacts, starts + side * width / 2) for side in (1, -1))
    return (ahead - behind) / width
